"""Masks that frames of a `transforms.json` name (`mask_path`, as nerfstudio writes it), relative to the file.

They are files of one mask folder, so that their content counts where a run is found again: the folder that all of them share.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field, TypeAdapter, ValidationError

from gsbake.capture.poses.frames import PhotoIndex
from gsbake.capture.poses.validation import MAX_FRAMES, Strict, read_file, read_json_text
from gsbake.errors import BadInputError
from gsbake.text import missing_list


class _Frame(Strict):
    file_path: str = Field(min_length=1, max_length=4096)
    mask_path: str | None = Field(None, max_length=4096)


class _File(Strict):
    frames: list[_Frame] = Field(max_length=MAX_FRAMES)


def frame_masks(poses: Path | None) -> dict[str, Path]:
    """Mask file of each frame that names one, by the frame's `file_path`; {} for other files, and for a file that its reader will refuse.

    Raises BadInputError for masks outside the file's folder, and as `read_file`.
    """
    if poses is None or poses.suffix.lower() != ".json" or b'"mask_path"' not in read_file(poses):
        return {}
    try:
        body = TypeAdapter(_File).validate_json(read_json_text(poses))
    except ValidationError:
        return {}
    root = Path(os.path.realpath(poses.parent))
    found, outside = {}, []
    for frame in body.frames:
        if frame.mask_path:
            path = root / frame.mask_path.replace("\\", "/").replace("\0", "?")
            found[frame.file_path] = path = Path(os.path.realpath(path.parent)) / path.name
            if not path.is_relative_to(root):
                outside.append(frame.mask_path)
    if outside:
        raise BadInputError(
            f"{len(outside)} masks that {poses} names lie outside its folder ({missing_list(outside)}); if that is meant, name their "
            "folder with --masks."
        )
    return found


def mask_folder(masks: Mapping[str, Path]) -> Path | None:
    """The folder that all of these mask files share; None where none of them exists."""
    return Path(os.path.commonpath({path.parent for path in masks.values()})) if any(map(os.path.isfile, masks.values())) else None


def masks_by_photo(masks: Mapping[str, Path], folder: Path | None, photos: Iterable[str], poses: Path) -> dict[str, Path]:
    """Mask file of each photo, of the `masks` by frame that `poses` names, those in the mask `folder`; {} where it was chosen otherwise.

    Raises BadInputError when masks do not exist.
    """
    index, found = PhotoIndex(photos), {}
    for frame, path in masks.items():
        photo = index.match(frame)
        if photo is not None and (folder is None or path.is_relative_to(folder.resolve())):
            found[photo] = path
    missing = sorted({path.relative_to(poses.parent.resolve()).as_posix() for path in found.values() if not os.path.isfile(path)})
    if missing:
        raise BadInputError(
            f"{len(missing)} masks that {poses} names do not exist ({missing_list(missing)}); export them again, remove mask_path, or give "
            "--masks none."
        )
    return found
