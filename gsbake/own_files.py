"""What gsbake may write: into a folder that is new, empty or its own, and over a file that is new or as gsbake wrote it.

Every command that writes asks here. What is somebody else's is neither changed nor deleted: a folder is refused, a file stays under its
name and the new one is written beside it (`asset.new.glb`), and what has to make room is moved to a folder `set-aside`.
"""

from __future__ import annotations

import filecmp
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from pathlib import Path, PurePosixPath

from gsbake.errors import UsageError
from gsbake.text import shortlist

#: Folder, in an output folder, of files that had to make room. gsbake deletes nothing there.
SET_ASIDE = "set-aside"
#: Files that file managers leave in folders they show.
FILE_MANAGER_FILES = frozenset({".DS_Store", "Thumbs.db", "desktop.ini", ".directory"})
#: What a killed process leaves of a file that was not finished (gsbake.atomic), of a probe of the disk, and of the built-in capture.
_UNFINISHED = re.compile(r"\.(.+\.\d+\.[0-9a-f]{8}\.tmp|probe-[0-9a-f]{8}|synth-[0-9a-f]{8})")
#: A file that was published beside somebody else's: the name of that one before and after `.new`.
_NEW_NAME = re.compile(r"(.+)\.new\d*(\.[^./]+)")


def entries(folder: Path) -> list[str]:
    """Sorted names in a folder, without those of file managers and of unfinished files; none where there is no folder."""
    try:
        names = os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    return sorted(name for name in names if name not in FILE_MANAGER_FILES and not _UNFINISHED.fullmatch(name))


def require_own_folder(folder: Path, own: bool, what: str) -> None:
    """Raise UsageError unless the folder is new, empty or gsbake's `own`; `what` would be written there."""
    if not own and (found := entries(folder)):
        raise UsageError(f"'{folder}' holds other files ({shortlist(found)}), so {what} is not written there; name a new or empty folder.")


def require_new_file(path: Path, inputs: Iterable[Path], *, overwrite: bool) -> None:
    """Raise UsageError where `path`, which the user names for an output, is one of the `inputs`, or exists and shall not be replaced."""
    if not os.path.lexists(path):
        return
    if any(given.exists() and path.exists() and os.path.samefile(given, path) for given in inputs):
        raise UsageError(f"'{path}' is an input of this command; name another file for the output.")
    if path.is_dir():
        raise UsageError(f"'{path}' is a folder; name a file.")
    if not overwrite:
        raise UsageError(f"'{path}' exists already; name another file, or replace it with --overwrite.")


def own_place(path: Path, is_own: Callable[[Path], bool]) -> Path:
    """Where to write `path`: there, if nothing is there or a file that gsbake wrote (`is_own`), else at the first of its new names of which
    that holds. A link or folder is never gsbake's."""
    for place in (path, *_few_new_paths(path)):
        if not os.path.lexists(place) or is_own_file(place, is_own):
            return place
    raise UsageError(f"'{path}' and the files beside it are not gsbake's; move them away.")


def is_own_file(path: Path, is_own: Callable[[Path], bool]) -> bool:
    """Whether `path` is a file, no link or folder, that gsbake wrote (`is_own`)."""
    return not path.is_symlink() and path.is_file() and is_own(path)


def replaced_name(name: str) -> str | None:
    """The name beside which `name` is a new one: `asset.glb` of `asset.new.glb`; None of any other name."""
    found = _NEW_NAME.fullmatch(name)
    return None if found is None else found[1] + found[2]


def set_aside(path: Path, target: Path) -> Path:
    """Move a file, link or folder to `target`, or to a free name beside it; returns where it lies. A file whose bytes lie there
    already is deleted."""
    if os.path.lexists(target) and _equal_files(path, target):
        path.unlink()
        return target
    numbers = count(2)
    place = target
    while os.path.lexists(place):
        place = target.with_name(f"{target.stem}.{next(numbers)}{target.suffix}")
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(path, place)
    return place


def _equal_files(first: Path, second: Path) -> bool:
    plain = not first.is_symlink() and not second.is_symlink() and first.is_file() and second.is_file()
    return plain and filecmp.cmp(first, second, shallow=False)


def _few_new_paths(path: Path) -> Iterator[Path]:
    """`asset.new.glb`, `asset.new2.glb`, … of `asset.glb`."""
    plain = PurePosixPath(path.name)
    for number in range(1, 100):
        yield path.with_name(f"{plain.stem}.new{'' if number == 1 else number}{plain.suffix}")
