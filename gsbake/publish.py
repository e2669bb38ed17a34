"""Publication of a run's results in its output folder: asset.glb, cameras.json, light.hdr, report.html, and the files of targets.

A file there that is not as gsbake published it is the user's: it stays, and the new one is published beside it as `asset.new.glb`, or in
its place where the user says so; then theirs is set aside.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from gsbake.config.targets import is_target_file
from gsbake.own_files import SET_ASIDE, is_own_file, own_place, replaced_name, set_aside
from gsbake.pipeline.files import copy_atomic
from gsbake.pipeline.project import Project
from gsbake.pipeline.store import Artifact, Store
from gsbake.system.names import is_digest, unusable_name
from gsbake.text import shortlist

#: {stage: files that are copied to the output folder}.
RESULTS = {"export": ("asset.glb", "cameras.json", "light.hdr"), "report": ("report.html",)}
#: Stage whose files are all results, but for these suffixes and names.
TARGETS, INTERNAL = "targets", (".audit.json", "targets.json")


@dataclass(frozen=True)
class Publication:
    """What was published: {file: path}, the project with the digests of the published files, and (stage, sentence) of what needs a word."""

    files: dict[str, Path]
    project: Project
    notes: tuple[tuple[str, str], ...]


def is_result(name: str) -> bool:
    """Whether `name` is one that gsbake publishes, itself or beside a file of the user's."""
    plain = replaced_name(name) or name
    return plain in {file for names in RESULTS.values() for file in names} or is_target_file(plain)


def publish_results(
    out: Path, artifacts: Mapping[str, Artifact], project: Project, store: Store, *, overwrite: bool = False
) -> Publication:
    """Copy the results of the artifacts to the output folder.

    Copies, not links: saving the asset in another program must not change the artifact. A file that this run no longer has (light.hdr
    without materials) is deleted if it is unchanged since an earlier run published it. With `overwrite` a file of the user's in the place
    of a result is set aside.
    """
    publisher = _Publisher(out, store, _usable(project.published), overwrite)
    for stage in (*RESULTS, TARGETS):
        if stage in artifacts:
            publisher.publish(stage, artifacts[stage])
    return Publication(publisher.files, replace(project, published=publisher.published), tuple(publisher.notes))


def published_results(out: Path, artifacts: Mapping[str, Artifact], project: Project) -> dict[str, Path | None]:
    """{result: its path in the output folder, None where it is not published}, by the project's record; no file is read."""
    published = _usable(project.published)
    found: dict[str, Path | None] = {}
    for stage, names in RESULTS.items():
        for name in names:
            if stage in artifacts and name in artifacts[stage].files:
                places = [*_beside(name, published), name]
                same = (out / place for place in places if published.get(place) == artifacts[stage].files[name])
                found[name] = next((path for path in same if path.is_file()), None)
    return found


class _Publisher:
    """Publishes the results of stages one after another."""

    def __init__(self, out: Path, store: Store, published: dict[str, str], overwrite: bool) -> None:
        self.out, self.store, self.published, self.overwrite = out, store, published, overwrite
        self.files: dict[str, Path] = {}
        self.notes: list[tuple[str, str]] = []

    def publish(self, stage: str, artifact: Artifact) -> None:
        """Place the results of a stage, and delete those that it no longer has."""
        for name in self._names(stage, artifact):
            if all(not folder.is_symlink() and (folder.is_dir() or not folder.exists()) for folder in self._folders(name)):
                self._place(stage, name, artifact)
            else:
                self.notes.append((stage, f"'{name}' is not published: its folder in '{self.out}' is a file or a link; move that away."))
        earlier = {replaced_name(name) or name for name in self.published}
        own = {name for name in earlier if (name in RESULTS[stage] if stage in RESULTS else is_target_file(name))}
        for name in own - set(artifact.files):
            for place in (name, *_beside(name, self.published)):
                self._withdraw(place)

    def _names(self, stage: str, artifact: Artifact) -> list[str]:
        if stage in RESULTS:
            return [name for name in RESULTS[stage] if name in artifact.files]
        names = sorted(name for name in artifact.files if not name.endswith(INTERNAL))
        bad = [name for name in names if not is_target_file(name)]
        if bad:
            self.notes.append((stage, f"{shortlist(bad)}: not published, because no target has files of that name."))
        return [name for name in names if is_target_file(name)]

    def _place(self, stage: str, name: str, artifact: Artifact) -> None:
        path, digest = self.out / name, artifact.files[name]

        def is_own(place: Path) -> bool:
            with suppress(OSError):
                there = self.store.digests.file(place)
                return there in (digest, self.published.get(self._name(place))) or there in self._stored(stage, name)
            return False  # it cannot be read

        if self.overwrite and os.path.lexists(path) and not is_own_file(path, is_own):
            moved = set_aside(path, self.out / SET_ASIDE / name)
            self.notes.append((stage, f"'{path}' was not as gsbake published it; it lies in '{moved}' now."))
        path.parent.mkdir(exist_ok=True)
        place = own_place(path, is_own)
        if not place.is_file() or self.store.digests.file(place) != digest:
            copy_atomic(artifact.folder / name, place)
        for other in _beside(name, self.published):
            if other != self._name(place):
                self._withdraw(other)
        self.published[self._name(place)] = digest
        self.files[name] = place
        if place != path:
            text = f"'{path}' is not as gsbake published it and stays; the new one is '{place.name}'. --overwrite sets yours aside."
            self.notes.append((stage, text))

    def _withdraw(self, name: str) -> None:
        """Delete a published file that has no use any more, unless it was edited."""
        path, digest = self.out / name, self.published.pop(name, None)
        plain = not any(folder.is_symlink() for folder in self._folders(name))
        if plain and is_own_file(path, lambda place: self.store.digests.file(place) == digest):
            path.unlink()

    def _stored(self, stage: str, name: str) -> set[object]:
        """Digests of the file in all stored outputs of the stage: a killed run may have published one and not recorded it."""
        return {manifest["files"].get(name, {}).get("digest") for _, manifest in self.store.manifests(stage)}

    def _folders(self, name: str) -> list[Path]:
        return [path for path in (self.out / name).parents if path != self.out and path.is_relative_to(self.out)]

    def _name(self, place: Path) -> str:
        return place.relative_to(self.out).as_posix()


def _beside(name: str, published: Mapping[str, str]) -> list[str]:
    """The recorded names of results that were published beside a file of the user's called `name`."""
    return sorted(other for other in published if replaced_name(other) == name)


def _usable(published: Mapping[str, str]) -> dict[str, str]:
    """The entries of a project's record that can be true: names that gsbake publishes, and digests."""
    return {name: digest for name, digest in published.items() if is_digest(digest) and unusable_name([name]) is None and is_result(name)}
