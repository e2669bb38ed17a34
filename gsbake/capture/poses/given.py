"""Reader of known poses in any supported format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbake.capture.poses.frames import GivenPoses, PhotoSize
from gsbake.capture.poses.llff import read_llff
from gsbake.capture.poses.metashape import read_metashape
from gsbake.capture.poses.transforms_json import read_transforms


def read_poses(path: Path, listing: Sequence[str], sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Cameras for the photos, in the frame of the file.

    `path` is a transforms.json, a poses_bounds.npy, a Metashape XML or a COLMAP model folder; `listing` names all photos in order (LLFF
    poses refer to photos by order), `sizes` holds the readable ones. Raises BadInputError when the file or a pose is invalid or no frame
    matches a photo.
    """
    if path.is_dir():
        from gsbake.capture.poses.colmap_model import read_model

        return read_model(path, sizes)
    if path.suffix.lower() == ".npy":
        return read_llff(path, listing, sizes)
    if path.suffix.lower() == ".xml":
        return read_metashape(path, sizes)
    return read_transforms(path, sizes)
