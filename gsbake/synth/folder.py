"""The folder of the built-in capture: its mark, and what may be written there again.

`synth.json` lists the digests of the files that gsbake wrote. A photo that was edited or added since is the user's, and the folder is then
refused. A capture without the mark, of an earlier version, is recognised by its whole layout.
"""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from blake3 import blake3

from gsbake.atomic import write_atomic
from gsbake.errors import UsageError
from gsbake.own_files import entries, require_own_folder
from gsbake.system.names import is_digest, unusable_name

MARK = "synth.json"
#: Folders of ground truth with one image per photo, and further files of it.
TRUTH_IMAGES, TRUTH_FILES = ("masks", "albedo", "normal", "orm", "emission"), frozenset({"mesh.ply", "points.npz", "cameras.json"})
_PHOTO = re.compile(r"\d{3,5}\.png")


def is_capture(folder: Path) -> bool:
    """Whether a folder is a built-in capture: it has the mark, or the layout of an earlier version and nothing else."""
    return _read_mark(folder) is not None or _has_layout(folder)


def require_capture_folder(folder: Path) -> None:
    """Raise UsageError unless a capture may be written into the folder: it is new, empty or a capture that is as gsbake wrote it."""
    require_own_folder(folder, is_capture(folder), "the built-in capture")
    known = _read_mark(folder)
    if known is not None:
        require_unchanged(folder, known)


def require_unchanged(folder: Path, known: dict[str, list[str]]) -> None:
    """Raise UsageError for the first file that is none of the `known` ({name: digests})."""
    for name in _files(folder):
        path = folder / name
        if path.is_symlink() or not path.is_file() or blake3(path.read_bytes()).hexdigest() not in known.get(name, ()):
            raise UsageError(f"'{path}' is not as gsbake wrote it; move it away, or name a new folder for the built-in capture.")


def replace_capture(new: Path, folder: Path) -> None:
    """Move the files of the finished capture in the folder `new` to `folder`, in place of those of an earlier one.

    The mark names old and new files until all have moved, so that a killed process leaves nothing that looks like the user's.
    Raises UsageError, before anything is changed, for a file there that gsbake did not write.
    """
    made = {name: [blake3((new / name).read_bytes()).hexdigest()] for name in _files(new)}
    known = _read_mark(folder) or {}
    both = {name: [*known.get(name, ()), *made.get(name, ())] for name in {**known, **made}}
    require_unchanged(folder, both)
    _write_mark(folder, both)
    for name in made:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (new / name).replace(folder / name)
    for name in set(_files(folder)) - made.keys():
        (folder / name).unlink()
    _write_mark(folder, made)


def _write_mark(folder: Path, files: dict[str, list[str]]) -> None:
    write_atomic(folder / MARK, json.dumps({"format": 1, "files": dict(sorted(files.items()))}, indent=1), durable=True)


def _read_mark(folder: Path) -> dict[str, list[str]] | None:
    """{name: digests} of the files that gsbake wrote; None without a mark."""
    body: Any = None
    with suppress(OSError, ValueError, RecursionError):
        body = json.loads((folder / MARK).read_bytes())
    files = body.get("files") if isinstance(body, dict) else None
    if not isinstance(files, dict) or unusable_name(files) is not None:
        return None
    if not all(isinstance(digests, list) and all(map(is_digest, digests)) for digests in files.values()):
        return None
    return files


def _has_layout(folder: Path) -> bool:
    if not {"images", "truth"} <= set(entries(folder)) <= {"images", "truth", "transforms.json"}:
        return False
    photos, truth = entries(folder / "images"), set(entries(folder / "truth"))
    if not photos or not all(_PHOTO.fullmatch(name) for name in photos) or not truth >= TRUTH_FILES:
        return False
    return truth <= TRUTH_FILES | set(TRUTH_IMAGES) and all(entries(folder / "truth" / kind) == photos for kind in truth - TRUTH_FILES)


def _files(folder: Path) -> list[str]:
    """Relative names of what is in a folder and its subfolders, but for the mark and what is not looked at anywhere (`entries`)."""
    found = []
    for name in entries(folder):
        path = folder / name
        if path.is_dir() and not path.is_symlink():
            found += [f"{name}/{inner}" for inner in _files(path)]
        elif name != MARK:
            found.append(name)
    return found


def unfinished_folders(folder: Path) -> list[Path]:
    """Folders of captures that a killed process did not finish."""
    with suppress(OSError):
        return [folder / name for name in os.listdir(folder) if re.fullmatch(r"\.synth-[0-9a-f]{8}", name)]
    return []
