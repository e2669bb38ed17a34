"""Reader of known poses in any supported format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbake.capture.poses.folder_formats import has_xmp, is_colmap_model
from gsbake.capture.poses.frames import GivenPoses, PhotoSize
from gsbake.capture.poses.llff import read_llff
from gsbake.capture.poses.metashape import read_metashape
from gsbake.capture.poses.openmvg import read_openmvg
from gsbake.capture.poses.opensfm import read_opensfm
from gsbake.capture.poses.polycam import read_polycam
from gsbake.capture.poses.reality_scan import read_reality_scan_csv, read_reality_scan_xmp
from gsbake.capture.poses.transforms_json import read_transforms
from gsbake.capture.poses.validation import read_file


def read_poses(path: Path, listing: Sequence[str], sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Cameras for the photos, in the frame of the file.

    `path` is a file or folder that `gsbake.capture.sources` takes for poses; `listing` names all photos in order (LLFF poses refer to
    photos by order), `sizes` holds the readable ones. Raises BadInputError when the file or a pose is invalid or no frame matches a photo.
    """
    if path.is_dir():
        if not is_colmap_model(path):
            return (read_reality_scan_xmp if has_xmp(path) else read_polycam)(path, sizes)
        from gsbake.capture.poses.colmap_model import read_model

        return read_model(path, sizes)
    if path.suffix.lower() == ".npy":
        return read_llff(path, listing, sizes)
    if path.suffix.lower() == ".xml":
        return read_metashape(path, sizes)
    if path.suffix.lower() == ".csv":
        return read_reality_scan_csv(path, sizes)
    return _read_json(path, sizes)


def _read_json(path: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a JSON file: OpenSfM writes a list, OpenMVG the version of its format first, all others a transforms.json."""
    start = read_file(path, 1000).lstrip()
    if start.startswith(b"[") and path.name != "transforms.json":
        return read_opensfm(path, sizes)
    return (read_openmvg if b'"sfm_data_version"' in start else read_transforms)(path, sizes)
