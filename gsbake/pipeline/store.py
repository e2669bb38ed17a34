"""Where artifacts lie and when they count: OUT/stages/<stage>/<key>/ with a manifest that is written last.

A stage fills a temporary folder beside the final one (same file system); it is flushed to disk and renamed in one step. So a
folder with the right name is whole, whatever was killed when. Its files' digests stand in the manifest and are compared at every
look-up: a file that was edited or damaged afterwards makes the artifact count as missing.
"""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from blake3 import blake3

from gsbake.pipeline.digest import DigestCache, list_files, tree_digest
from gsbake.pipeline.files import remove_tree, sync, sync_tree, write_atomic
from gsbake.pipeline.key import SHORT, Ingredients

MANIFEST = "manifest.json"
REPLACED = "replaced.json"


@dataclass(frozen=True)
class Artifact:
    """A published stage folder: its files' digests, their common digest, and the manifest."""

    folder: Path
    files: Mapping[str, str]
    manifest: Mapping[str, Any]
    by_hand: bool = False

    @property
    def digest(self) -> str:
        """Content digest of all files, the manifest left out."""
        return tree_digest(self.files)


@dataclass(frozen=True)
class Lookup:
    """What the store holds for a key: a whole artifact, or why there is none."""

    artifact: Artifact | None = None
    faults: tuple[str, ...] = field(default=())


class Store:
    """The artifacts under one output folder."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.digests = DigestCache(out / "digests.json")

    def stage_folder(self, stage: str) -> Path:
        """Folder of all artifacts of a stage."""
        return self.out / "stages" / stage

    def folder(self, stage: str, key: str) -> Path:
        """Final folder of the artifact with this key."""
        return self.stage_folder(stage) / key[:SHORT]

    def checkpoint(self, stage: str, key: str) -> Path:
        """Folder that survives an interruption of the stage."""
        return self.stage_folder(stage) / f"{key[:SHORT]}.checkpoint"

    def look_up(self, what: Ingredients) -> Lookup:
        """The artifact for these ingredients, or what keeps the stored one from counting."""
        folder = self.folder(what.stage, what.key)
        manifest = read_manifest(folder)
        if manifest is None:
            return Lookup()
        faults = []
        if manifest.get("key") != what.key:
            faults.append("another key shares its folder name")
        recorded = manifest.get("settings", {})
        for name, value in what.settings.items():
            if name in recorded and recorded[name] != value:
                faults.append(f"{name}: {recorded[name]} → {value} (the schema's default changed)")
        if not faults:
            faults = self._file_faults(folder, manifest)
        if faults:
            return Lookup(None, tuple(faults))
        return Lookup(self._artifact(folder, manifest))

    def replacement(self, stage: str) -> Lookup | None:
        """The output that a person put in place of this stage's own, if any."""
        note = self.stage_folder(stage) / REPLACED
        try:
            folder = self.stage_folder(stage) / str(json.loads(note.read_text())["folder"])
        except (OSError, ValueError, KeyError):
            return None
        manifest = read_manifest(folder)
        if manifest is None:
            return Lookup(None, ("the files put in place by hand are gone",))
        faults = self._file_faults(folder, manifest)
        return Lookup(None, tuple(faults)) if faults else Lookup(self._artifact(folder, manifest))

    def manifests(self, stage: str) -> list[tuple[Path, dict[str, Any]]]:
        """All artifacts of the stage that it computed itself, the newest first."""
        found = []
        with suppress(FileNotFoundError):
            for folder in self.stage_folder(stage).iterdir():
                if len(folder.name) == SHORT and (manifest := read_manifest(folder)) is not None:
                    found.append((folder, manifest))
        return sorted(found, key=lambda pair: str(pair[1].get("finished", "")), reverse=True)

    def temporary(self, stage: str, key: str) -> Path:
        """A new empty folder to fill for this key."""
        folder = self.stage_folder(stage) / f"{key[:SHORT]}.tmp-{uuid.uuid4().hex[:8]}"
        folder.mkdir(parents=True)
        return folder

    def publish(self, temporary: Path, final: Path, manifest: Mapping[str, Any]) -> Artifact:
        """Make the filled `temporary` folder the artifact `final`; the files' digests and sizes are added to the manifest."""
        sync_tree(temporary)
        names = [name for name in list_files(temporary) if name != MANIFEST]
        files = self.digests.files(temporary, names)
        sizes = {name: (temporary / name).stat().st_size for name in names}
        body = {**manifest, "digest": tree_digest(files), "files": {n: {"digest": files[n], "bytes": sizes[n]} for n in names}}
        body["seal"] = _seal(body)
        write_atomic(temporary / MANIFEST, json.dumps(body, indent=1, ensure_ascii=False), durable=True)
        sync(temporary)
        if final.exists():  # a damaged one, or one made with another default
            old = final.with_name(f"{final.name}.tmp-{uuid.uuid4().hex[:8]}")
            final.rename(old)
            temporary.rename(final)
            remove_tree(old)
        else:
            temporary.rename(final)
        sync(final.parent)
        return self._artifact(final, body)

    def sweep(self, stage: str, key: str) -> None:
        """Delete what killed runs left behind for this key; the caller holds its lease."""
        with suppress(FileNotFoundError):
            for entry in self.stage_folder(stage).iterdir():
                if entry.name.startswith(f"{key[:SHORT]}.tmp-"):
                    remove_tree(entry)
                elif entry.name.startswith(f".{key[:SHORT]}.") and entry.suffix == ".tmp":  # a lease half written
                    entry.unlink(missing_ok=True)

    def _file_faults(self, folder: Path, manifest: Mapping[str, Any]) -> list[str]:
        faults = []
        for name, entry in manifest.get("files", {}).items():
            path = folder / name
            try:
                same = os.path.getsize(path) == entry["bytes"] and self.digests.file(path) == entry["digest"]
            except OSError:
                faults.append(f"{name} is gone from '{folder}'")
                continue
            if not same:
                faults.append(f"{name} in '{folder}' was changed after it was written")
        return faults

    @staticmethod
    def _artifact(folder: Path, manifest: Mapping[str, Any]) -> Artifact:
        files = {name: str(entry["digest"]) for name, entry in manifest.get("files", {}).items()}
        return Artifact(folder, files, manifest, by_hand=bool(manifest.get("replaced")))


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a folder; None when there is none, or not the one that was published (its seal is a digest of the rest)."""
    try:
        body = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return body if isinstance(body, dict) and body.get("seal") == _seal(body) else None


def _seal(manifest: Mapping[str, Any]) -> str:
    body = json.dumps({k: v for k, v in manifest.items() if k != "seal"}, sort_keys=True)
    return blake3(body.encode()).hexdigest()
