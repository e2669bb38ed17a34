"""Artifact store: OUT/stages/<stage>/<key>/, each with a manifest that is written last.

A stage fills a temporary folder beside the final one (same file system), which is flushed to disk and renamed atomically. So a folder with
a final name is complete even after a crash. The manifest lists the digests of its files; they are checked at every look-up. An artifact is
exactly the files of its manifest: a modified, damaged, missing or added file invalidates it. The digest cache answers for files whose
size, times and inode are unchanged; `verify` reads every byte.

Files of the user's are never deleted: an edited or added file that has to make room for an output is moved to OUT/set-aside/.
"""

from __future__ import annotations

import json
import os
import re
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from blake3 import blake3

from gsbake.atomic import write_atomic
from gsbake.own_files import FILE_MANAGER_FILES, SET_ASIDE, set_aside
from gsbake.pipeline.digest import DigestCache, tree_digest
from gsbake.pipeline.files import remove_tree, sync_tree
from gsbake.pipeline.key import KEY_PREFIX_LENGTH, CacheKey
from gsbake.system import disk
from gsbake.system.names import is_digest, unusable_name

MANIFEST = "manifest.json"
#: Name of the folder of parts of a stage's work that later runs use again.
CACHE = "cache"
REPLACEMENT = "replaced.json"
#: Start of the folder name of the user's replacement of a stage's output.
REPLACEMENT_PREFIX = "by-hand"
#: Folder name of a computed artifact, and of a replacement.
ARTIFACT_FOLDER = re.compile(rf"[0-9a-f]{{{KEY_PREFIX_LENGTH}}}")
#: Name of a temporary folder of an artifact or a replacement, and of an incomplete lease file.
TEMPORARY_FOLDER = re.compile(rf"([0-9a-f]{{{KEY_PREFIX_LENGTH}}}|{REPLACEMENT_PREFIX})\.tmp-[0-9a-f]{{8}}")
LEASE_LEFTOVER = re.compile(rf"\.([0-9a-f]{{{KEY_PREFIX_LENGTH}}}|{REPLACEMENT_PREFIX})\.lease\.[0-9a-f.]{{1,64}}\.tmp")
_REPLACEMENT_FOLDER = re.compile(rf"{REPLACEMENT_PREFIX}-[0-9a-f]{{8}}")
#: Kinds of a manifest's fields that may be absent.
_KINDS: Mapping[str, type] = {
    "settings": dict, "inputs": dict, "results": dict, "parts": dict, "host": dict, "versions": dict, "decisions": list, "warnings": list,
    "stage": str, "key": str,
}  # fmt: skip


@dataclass(frozen=True)
class Artifact:
    """A published artifact folder: {file: digest} and the manifest; `replaced` when it holds the user's files."""

    folder: Path
    files: Mapping[str, str]
    manifest: Mapping[str, Any]
    replaced: bool = False

    @property
    def digest(self) -> str:
        """Content digest of all files except the manifest."""
        return tree_digest(self.files)


@dataclass(frozen=True)
class Lookup:
    """Result of a look-up: a valid artifact, or what is wrong with the stored one."""

    artifact: Artifact | None = None
    faults: tuple[str, ...] = field(default=())


class _DamagedRecordError(Exception):
    """The record of a replacement cannot be used; the message says why."""


class Store:
    """The artifacts under one output folder."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.digests = DigestCache(out / "digests.json")
        self._moved: list[Path] = []

    def stage_folder(self, stage: str) -> Path:
        """Folder with all artifacts of a stage."""
        return self.out / "stages" / stage

    def folder(self, stage: str, key: str) -> Path:
        """Final folder of the artifact of a key."""
        return self.stage_folder(stage) / key[:KEY_PREFIX_LENGTH]

    def checkpoint(self, stage: str, key: str) -> Path:
        """Folder that survives an interruption of the stage."""
        return self.stage_folder(stage) / f"{key[:KEY_PREFIX_LENGTH]}.checkpoint"

    def cache(self, stage: str) -> Path:
        """Folder of parts of the stage's work that outlive its artifacts; may be deleted at any time."""
        return self.stage_folder(stage) / CACHE

    def look_up(self, cache_key: CacheKey) -> Lookup:
        """The artifact of a key, or what is wrong with the stored one."""
        folder = self.folder(cache_key.stage, cache_key.digest)
        manifest = read_manifest(folder)
        if manifest is None:
            return Lookup()
        faults = []
        if manifest.get("key") != cache_key.digest:
            faults.append("its folder holds the artifact of another key")
        recorded = manifest.get("settings", {})
        for name, value in cache_key.settings.items():
            if name in recorded and recorded[name] != value:
                faults.append(f"{name}: {recorded[name]} → {value} (the schema's default changed)")
        if not faults:
            faults = self._file_faults(folder, manifest)
        if faults:
            return Lookup(None, tuple(faults))
        return Lookup(self._artifact(folder, manifest))

    def replacement_folder(self, stage: str) -> Path | None:
        """Folder of the user's replacement of this stage's output; None when there is none. Raises _DamagedRecordError."""
        try:
            name = str(json.loads((self.stage_folder(stage) / REPLACEMENT).read_text(encoding="utf-8"))["folder"])
        except (FileNotFoundError, NotADirectoryError):
            if any(_REPLACEMENT_FOLDER.fullmatch(path.name) for path in self.stage_folder(stage).glob(f"{REPLACEMENT_PREFIX}-*")):
                raise _DamagedRecordError(f"{REPLACEMENT} is missing") from None
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            raise _DamagedRecordError(f"{REPLACEMENT} cannot be read") from None
        if not _REPLACEMENT_FOLDER.fullmatch(name):
            raise _DamagedRecordError(f"{REPLACEMENT} names the folder {name!r}")
        return self.stage_folder(stage) / name

    def replacement(self, stage: str) -> Lookup | None:
        """The user's replacement of this stage's output; None when there is none."""
        try:
            folder = self.replacement_folder(stage)
        except _DamagedRecordError as error:
            return Lookup(None, (str(error),))
        if folder is None:
            return None
        manifest = read_manifest(folder)
        if manifest is None or manifest.get("stage") != stage or not manifest.get("replaced"):
            return Lookup(None, ("its files are missing or its manifest is damaged",))
        faults = self._file_faults(folder, manifest)
        return Lookup(None, tuple(faults)) if faults else Lookup(self._artifact(folder, manifest))

    def mark_used(self, artifact: Artifact) -> None:
        """Set the folder's modification time to now, for the garbage collection."""
        with suppress(OSError):
            os.utime(artifact.folder)

    def manifests(self, stage: str) -> list[tuple[Path, dict[str, Any]]]:
        """(folder, manifest) of all artifacts that the stage computed, newest first."""
        found = []
        with suppress(FileNotFoundError):
            for folder in self.stage_folder(stage).iterdir():
                if ARTIFACT_FOLDER.fullmatch(folder.name) and (manifest := read_manifest(folder)) is not None:
                    found.append((folder, manifest))
        return sorted(found, key=lambda pair: str(pair[1].get("finished", "")), reverse=True)

    def temporary(self, stage: str, key: str) -> Path:
        """A new empty folder for the output of this key."""
        folder = self.stage_folder(stage) / f"{key[:KEY_PREFIX_LENGTH]}.tmp-{uuid.uuid4().hex[:8]}"
        folder.mkdir(parents=True)
        return folder

    def publish(self, temporary: Path, final: Path, manifest: Mapping[str, Any]) -> Artifact:
        """Publish the folder `temporary` as the artifact `final`; digests and sizes of its files are added to the manifest.

        What was edited or added by hand in a folder of that name is set aside; see `take_moved`.
        """
        sync_tree(temporary)
        names = [name for name in _list_all(temporary) if name != MANIFEST]
        files = self.digests.files(temporary, names)
        sizes = {name: (temporary / name).stat().st_size for name in names}
        body = {**manifest, "digest": tree_digest(files), "files": {n: {"digest": files[n], "bytes": sizes[n]} for n in names}}
        body["seal"] = _seal(body)
        write_atomic(temporary / MANIFEST, json.dumps(body, indent=1), durable=True)
        disk.sync(temporary)
        if final.exists():  # a damaged or edited artifact, or one of other schema defaults
            self.set_aside_changed(final)
            old = final.with_name(f"{final.name}.tmp-{uuid.uuid4().hex[:8]}")
            disk.replace(final, old)
            disk.replace(temporary, final)
            remove_tree(old)
        else:
            disk.replace(temporary, final)
        disk.sync(final.parent)
        return self._artifact(final, body)

    def remove_leftovers(self, stage: str, key: str) -> None:
        """Delete temporary files of killed runs for this key; the caller holds its lease."""
        prefix = key[:KEY_PREFIX_LENGTH]
        for entry in self.own_entries(stage):
            if TEMPORARY_FOLDER.fullmatch(entry.name) and entry.name.startswith(prefix) and entry.is_dir():
                remove_tree(entry)
            elif LEASE_LEFTOVER.fullmatch(entry.name) and entry.name.startswith(f".{prefix}.") and entry.is_file():
                entry.unlink(missing_ok=True)

    def own_entries(self, stage: str) -> list[Path]:
        """What is in a stage's folder, without links; nothing where the folder itself is one, or `stages/`, because it may be anybody's."""
        if self.behind_link(stage) is not None:
            return []
        with suppress(FileNotFoundError, NotADirectoryError):
            return [entry for entry in sorted(self.stage_folder(stage).iterdir()) if not entry.is_symlink()]
        return []

    def behind_link(self, stage: str) -> Path | None:
        """The link that the stage's folder is or lies behind, inside the output folder."""
        folder = self.stage_folder(stage)
        return next((path for path in (folder.parent, folder) if path.is_symlink()), None)

    def verify(self, stage: str) -> list[tuple[Path, list[str]]]:
        """(folder, faults) of every artifact and replacement of a stage, from the bytes on the disk."""
        fresh = Store(self.out)
        fresh.digests = DigestCache()
        found = []
        for folder in sorted(self.artifact_folders(stage)):
            manifest = read_manifest(folder)
            faults = ["its manifest is missing or damaged"] if manifest is None else fresh._file_faults(folder, manifest)
            found.append((folder, faults))
        return found

    def artifact_folders(self, stage: str) -> list[Path]:
        """Folders of published artifacts and replacements of a stage, damaged ones included."""
        with suppress(FileNotFoundError, NotADirectoryError):
            entries = list(self.stage_folder(stage).iterdir())
            return [e for e in entries if e.is_dir() and (ARTIFACT_FOLDER.fullmatch(e.name) or _REPLACEMENT_FOLDER.fullmatch(e.name))]
        return []

    def set_aside_unexpected(self, stage: str, cache_key: CacheKey | None) -> None:
        """Move files that the manifest does not list from the artifact that a run uses to OUT/set-aside/; see `take_moved`.

        Such a file would be read by later stages although no cache key accounts for it. The artifact is the user's replacement, else that
        of the key; others are not looked at.
        """
        folder = None
        with suppress(_DamagedRecordError):  # reported at the look-up
            folder = self.replacement_folder(stage) or (self.folder(stage, cache_key.digest) if cache_key is not None else None)
        manifest = None if folder is None else read_manifest(folder)
        if folder is not None and manifest is not None:
            self._set_aside(folder, _unexpected(folder, manifest))

    def set_aside_changed(self, folder: Path, given: Iterable[str] = ()) -> None:
        """Move the files of an artifact's folder that a stage did not write, or not as they are, to OUT/set-aside/, before the folder is
        deleted: files edited or added by hand, those that the user has `given`, and all where the manifest is damaged."""
        manifest = read_manifest(folder)
        if manifest is None:
            self._set_aside(folder, _list_all(folder))
            return
        changed = [name for name, entry in manifest["files"].items() if name in given or self._is_edited(folder, name, entry)]
        self._set_aside(folder, [*_unexpected(folder, manifest), *changed])

    def take_moved(self) -> list[Path]:
        """Where the files lie that were set aside since the last call."""
        moved, self._moved = self._moved, []
        return moved

    def _set_aside(self, folder: Path, names: Iterable[str]) -> None:
        target = self.out / SET_ASIDE / folder.parent.name / folder.name
        self._moved += [set_aside(folder / name, target / name) for name in names if os.path.lexists(folder / name)]

    def _is_edited(self, folder: Path, name: str, entry: Mapping[str, Any]) -> bool:
        try:
            return not self._is_intact(folder, name, entry)
        except (OSError, ValueError):
            return True

    def _is_intact(self, folder: Path, name: str, entry: Mapping[str, Any]) -> bool:
        """Whether a file is as its manifest says. Raises OSError where it cannot be read, ValueError for a name that no file can have."""
        return os.path.getsize(folder / name) == entry["bytes"] and self.digests.file(folder / name) == str(entry["digest"])

    def _file_faults(self, folder: Path, manifest: Mapping[str, Any]) -> list[str]:
        faults = [f"{name} in '{folder}' was added" for name in _unexpected(folder, manifest)]
        for name, entry in manifest.get("files", {}).items():
            try:
                intact = self._is_intact(folder, name, entry)
            except (OSError, ValueError):  # ValueError: a name that no file can have
                faults.append(f"{name} is missing in '{folder}'")
                continue
            if not intact:
                faults.append(f"{name} in '{folder}' was modified")
        return faults

    @staticmethod
    def _artifact(folder: Path, manifest: Mapping[str, Any]) -> Artifact:
        files = {name: str(entry["digest"]) for name, entry in manifest.get("files", {}).items()}
        return Artifact(folder, files, manifest, replaced=bool(manifest.get("replaced")))


def lease_path(folder: Path) -> Path:
    """The lease file of an artifact, replacement, checkpoint or temporary folder."""
    prefix = REPLACEMENT_PREFIX if folder.name.startswith(REPLACEMENT_PREFIX) else folder.name[:KEY_PREFIX_LENGTH]
    return folder.with_name(f"{prefix}.lease")


def _list_all(folder: Path) -> list[str]:
    """Sorted relative POSIX names of all files, hidden ones included, and of links to folders; without those of file managers."""
    found = []
    for root, folders, names in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        found += [Path(root, name).relative_to(folder).as_posix() for name in [*names, *links] if name not in FILE_MANAGER_FILES]
    return sorted(found)


def _unexpected(folder: Path, manifest: Mapping[str, Any]) -> list[str]:
    """The files of an artifact's folder that its manifest does not list."""
    listed = {MANIFEST, *manifest.get("files", {})}
    return [name for name in _list_all(folder) if name not in listed]


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a folder; None when it is missing, damaged or modified (its `seal` is a digest of the other fields)."""
    try:
        return parse_manifest((folder / MANIFEST).read_bytes())
    except OSError:
        return None


def parse_manifest(content: bytes) -> dict[str, Any] | None:
    """The manifest in the bytes of a file; None when it is damaged or modified."""
    try:
        body = json.loads(content.decode("utf-8"))
        intact = isinstance(body, dict) and body.get("seal") == _seal(body)
    except (ValueError, RecursionError):
        return None
    return body if intact and _well_formed(body) else None


def _well_formed(body: Mapping[str, Any]) -> bool:
    """Whether a manifest's fields are of the kinds that gsbake writes, and its files have digests, sizes, and names of files that can lie
    together in the artifact's folder. The seal does not tell: anybody can make one."""
    files, inputs = body.get("files"), body.get("inputs", {})
    if not isinstance(files, dict) or not all(isinstance(body.get(name, kind()), kind) for name, kind in _KINDS.items()):
        return False
    entries = [entry if isinstance(entry, dict) else {} for entry in files.values()]
    sized = all(is_digest(e.get("digest")) and type(e.get("bytes")) is int and e["bytes"] >= 0 for e in entries)
    nested = [entry for known in inputs.values() for entry in (known, isinstance(known, dict) and known.get("files", {}))]
    named = MANIFEST not in files and unusable_name([*files, MANIFEST]) is None
    return sized and named and all(isinstance(entry, dict) for entry in nested)


def _seal(manifest: Mapping[str, Any]) -> str:
    body = json.dumps({k: v for k, v in manifest.items() if k != "seal"}, sort_keys=True)
    return blake3(body.encode()).hexdigest()
