"""`poses_bounds.npy` of LLFF (Mildenhall et al., *Local Light Field Fusion*, 2019).

Row n is the flattened 3x5 matrix [camera-to-world | (height, width, focal)] of the n-th photo by name, then the near and far depth.
Its camera axes are (down, right, backwards).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.poses.frames import GivenPoses, PhotoSize, checked_rigid, fit_to_photo
from gsbake.capture.poses.validation import check_file_size
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.imaging.npy import read_npy


def read_llff(path: Path, listing: Sequence[str], sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a poses_bounds.npy; `listing` names all photo files in order, `sizes` holds the readable ones.

    Raises BadInputError when there is not one row per photo, for NaN, and for a matrix that is no rigid motion.
    """
    rows = _load(path, len(listing))
    cameras = {}
    for row, photo in zip(rows, listing, strict=True):
        matrix = row[:15].reshape(3, 5)
        down, right, back, centre = matrix[:, 0], matrix[:, 1], matrix[:, 2], matrix[:, 3]
        rot, centre = checked_rigid(np.stack([right, down, -back], 1), centre, photo, str(path))
        height, width, focal = (float(x) for x in matrix[:, 4])
        if not np.isfinite(matrix[:, 4]).all() or min(height, width) < 1:
            raise BadInputError(f"The intrinsics of frame {photo} in {path} are invalid.")
        if photo not in sizes:
            continue
        camera = Camera(photo, round(width), round(height), focal, focal, width / 2, height / 2, rot.T, -rot.T @ centre)
        cameras[photo] = fit_to_photo(camera, sizes[photo], str(path))
    return GivenPoses(cameras)


def _load(path: Path, count: int) -> NDArray[np.float64]:
    """The array (count, 17) of the file, whose header is checked before the data are read."""
    check_file_size(path)
    try:
        values = read_npy(path)
    except (OSError, ValueError) as error:
        raise BadInputError(f"{path} cannot be read as a NumPy array ({' '.join(str(error).split())[:200]}).") from error
    if values.ndim != 2 or values.shape[1] != 17:
        raise BadInputError(f"{path} holds an array of shape {values.shape}; LLFF poses have 17 numbers per photo.")
    if len(values) != count:
        raise BadInputError(f"{path} has {len(values)} poses but there are {count} photos; use the photos the poses were made with.")
    return values.astype(np.float64)
