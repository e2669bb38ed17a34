"""`poses_bounds.npy` of LLFF (Mildenhall et al., *Local Light Field Fusion*, 2019).

Row n is the flattened 3x5 matrix [camera-to-world | (height, width, focal)] of the n-th photo by name, then the near and far depth.
Its camera axes are (down, right, backwards).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsbake.capture.poses.frames import Given, PhotoSize, checked_intrinsics, fit_to_photo, rigid
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera


def read_llff(path: Path, listing: Sequence[str], sizes: Mapping[str, PhotoSize]) -> Given:
    """Poses of a poses_bounds.npy; `listing` names all photo files in order, `sizes` has the readable ones.

    Raises BadInputError when the rows are not one per photo, for NaN and for a matrix that is no rigid motion.
    """
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise BadInputError(f"{path} cannot be read as a NumPy array ({error}).") from error
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise BadInputError(f"{path} holds an array of shape {rows.shape}; LLFF poses have 17 numbers a photo.")
    if len(rows) != len(listing):
        raise BadInputError(f"{path} has {len(rows)} poses but there are {len(listing)} photos; use the photos the poses were made with.")
    cameras = {}
    for row, photo in zip(np.asarray(rows, float), listing, strict=True):
        matrix = row[:15].reshape(3, 5)
        down, right, back, centre = matrix[:, 0], matrix[:, 1], matrix[:, 2], matrix[:, 3]
        rot, centre = rigid(np.stack([right, down, -back], 1), centre, photo, str(path))
        height, width, focal = matrix[:, 4]
        if not np.isfinite(matrix[:, 4]).all() or min(height, width) < 1:
            raise BadInputError(f"The intrinsics of frame {photo} in {path} are unusable.")
        if photo not in sizes:
            continue
        camera = Camera(photo, round(width), round(height), focal, focal, width / 2, height / 2, rot.T, -rot.T @ centre)
        cameras[photo] = checked_intrinsics(fit_to_photo(camera, sizes[photo], str(path)), str(path))
    return Given(cameras)
