"""The captures that the studio shows: those of a folder, or the one of a run. A request's path leads to a file of a capture or nowhere.

In FOLDER lie captures as the command line takes them, `FOLDER/chair/` with its photos, and their output folders as it makes them,
`FOLDER/out/chair/`. Every command that a page shows is typed in FOLDER.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gsbake.capture.sources import (
    PHOTO_FOLDERS,
    PHOTO_SUFFIXES,
    SKIPPED_FOLDERS,
    VIDEO_SUFFIXES,
    Sources,
    discover,
    is_video,
    list_photos,
)
from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.pipeline.project import PROJECT, Project
from gsbake.system.names import portable_name, same_file_key, unusable_name

#: Folder of output folders, and of thumbnails and results of checks, which may be deleted at any time.
OUT, CACHE = "out", ".gsbake-studio"
#: Folder of the photos of a new capture.
PHOTOS = PHOTO_FOLDERS[0]
#: Files that are looked at to tell whether a folder is a capture.
_MOST_LOOKED_AT = 2000


class NotFoundError(GsbakeError):
    """A request names what is not there."""


@dataclass(frozen=True)
class Capture:
    """A capture: its `name` and folder, its output folder, the folder of its cache, and the folder in which commands are typed."""

    name: str
    folder: Path
    out: Path
    cache: Path
    root: Path

    @property
    def source(self) -> Path:
        """What `gsbake run` takes: the folder, or the only video in it."""
        if self.folder.is_dir() and not self._has_photos():
            videos = [path for path in sorted(self.folder.rglob("*")) if is_video(path) and not path.name.startswith(".")]
            if len(videos) == 1:
                return videos[0]
        return self.folder

    def sources(self) -> Sources:
        """Photos, masks and poses. Raises BadInputError where there are no photos."""
        project = self.project
        masks = None if project is None or project.masks is None else Path(project.masks)
        found = discover(self.source)
        return found if masks is None or found.masks is not None or not masks.is_dir() else Sources(found.photos, masks, found.poses)

    @property
    def project(self) -> Project | None:
        """The options stored in the output folder; None without any."""
        return Project.load(self.out)

    def photos(self) -> dict[str, Path]:
        """{path in the photos' folder: file} of the photos; empty without any, and for a video. Links that lead elsewhere are left out."""
        with suppress(BadInputError):
            found = self.sources().photos
            if found.is_dir():
                inside = {path.relative_to(found).as_posix(): path for path in list_photos(found)}
                return {name: path for name, path in inside.items() if is_inside(path, found)}
        return {}

    def photo(self, name: str) -> Path:
        """The file of a photo. Raises NotFoundError."""
        found = self.photos().get(name)
        if found is None:
            raise NotFoundError(f"The capture {self.name} has no photo '{name}'.")
        return found

    def output(self, name: str) -> Path:
        """A file in the output folder. Raises NotFoundError for what is none, or lies elsewhere."""
        path = self.out / name
        if unusable_name([name]) is not None or not is_inside(path, self.out) or not path.is_file():
            raise NotFoundError(f"The run of {self.name} has no file '{name[:80]}'.")
        return path

    def shown(self, path: Path) -> str:
        """A path as one types it in the folder of captures."""
        with suppress(ValueError):
            return path.relative_to(self.root).as_posix()
        return str(path)

    def _has_photos(self) -> bool:
        with suppress(BadInputError):
            return bool(list_photos(next((f for name in PHOTO_FOLDERS if (f := self.folder / name).is_dir()), self.folder)))
        return False


class Workspace(Protocol):
    """What the server shows."""

    @property
    def name(self) -> str:
        """What the page calls it."""

    @property
    def grows(self) -> bool:
        """Whether captures can be added."""

    def captures(self) -> Sequence[Capture]:
        """All captures, by name."""

    def capture(self, name: str) -> Capture:
        """One capture. Raises NotFoundError."""

    def create(self, name: str) -> Capture:
        """A new, empty capture. Raises UsageError for a name that cannot be one."""


class Folder:
    """The captures in one folder."""

    grows = True

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise UsageError(f"'{folder}' is no folder; name the one that holds your captures.")
        self.folder = folder.resolve()
        self.name = self.folder.name or str(self.folder)
        if any((self.folder / name).is_dir() for name in PHOTO_FOLDERS) or _holds_photos(self.folder):
            raise UsageError(f"'{folder}' is itself a capture; name the folder that holds it.")

    def captures(self) -> list[Capture]:
        """The folders in which photos or videos lie, or shall lie, by name."""
        found = [self._capture(path.name) for path in sorted(self.folder.iterdir()) if self._may_be_capture(path)]
        return [capture for capture in found if capture is not None]

    def capture(self, name: str) -> Capture:
        """One capture. Raises NotFoundError."""
        found = self._capture(name) if unusable_name([name]) is None and "/" not in name else None
        if found is None or not self._may_be_capture(found.folder):
            raise NotFoundError(f"There is no capture '{name[:80]}'.")
        return found

    def create(self, name: str) -> Capture:
        """Make the folder of a new capture. Raises UsageError for a name that cannot be one, or is in use."""
        if unusable_name([name]) is not None or "/" in name or name.startswith(".") or portable_name(name) != name:
            raise UsageError(f"'{name[:80]}' cannot be the name of a capture on every system; use letters, digits, '-' and '_'.")
        key = same_file_key(name)
        if key in (OUT, *PHOTO_FOLDERS, *SKIPPED_FOLDERS) or any(same_file_key(path.name) == key for path in self.folder.iterdir()):
            raise UsageError(f"There is already a file or folder '{name}'; choose another name.")
        (self.folder / name / PHOTOS).mkdir(parents=True)
        return self.capture(name)

    def _capture(self, name: str) -> Capture | None:
        folder, out = self.folder / name, portable_name(name)
        if name == OUT or name.startswith("."):
            return None
        return Capture(name, folder, self.folder / OUT / out, self.folder / CACHE / out, self.folder)

    def _may_be_capture(self, path: Path) -> bool:
        if not path.is_dir() or not is_inside(path, self.folder):
            return False
        inner = [path / name for name in PHOTO_FOLDERS if (path / name).is_dir()]
        return all(is_inside(photos, self.folder) for photos in inner) and (bool(inner) or _holds_photos(path))


@dataclass(frozen=True)
class OneRun:
    """The one capture of a run, whose photos and output folder may lie anywhere."""

    only: Capture
    grows = False

    @staticmethod
    def of(photos: Path, out: Path) -> OneRun:
        """The workspace of a run with these photos and this output folder."""
        photos, out = photos.resolve(), out.resolve()
        folder = photos.parent if photos.name in PHOTO_FOLDERS else photos
        return OneRun(Capture(out.name, folder, out, out / CACHE, Path.cwd()))

    @property
    def name(self) -> str:
        """The run's name."""
        return self.only.name

    def captures(self) -> list[Capture]:
        """The capture."""
        return [self.only]

    def capture(self, name: str) -> Capture:
        """The capture by its name. Raises NotFoundError."""
        if name != self.only.name:
            raise NotFoundError(f"There is no capture '{name[:80]}'.")
        return self.only

    def create(self, name: str) -> Capture:
        """Raises UsageError: there is one capture."""
        raise UsageError("This page shows one run; `gsbake studio FOLDER` makes new captures.")


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path leads to something in the folder, links followed."""
    with suppress(OSError, ValueError, RuntimeError):
        return path.resolve().is_relative_to(folder.resolve())
    return False


def _holds_photos(folder: Path) -> bool:
    """Whether photos or videos lie directly in a folder that holds no run."""
    with suppress(OSError):
        if (folder / PROJECT).exists():
            return False
        for count, path in enumerate(folder.iterdir()):
            if path.suffix.lower() in PHOTO_SUFFIXES | VIDEO_SUFFIXES and not path.name.startswith("."):
                return True
            if count > _MOST_LOOKED_AT:
                break
    return False
