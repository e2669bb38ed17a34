"""Given maps of normals and depth per photo, resampled to the training photos: priors from any source; none are computed here.

A capture folder with `images/` or `photos/` may hold `normals/` and `depths/` beside it, one file per photo with the photo's name:

| | formats | values |
|---|---|---|
| normals | 8- or 16-bit PNG (colour), `.npy` (h, w, 3) | (n + 1) / 2 of the range, or n; zero length where unknown |
| depths | 16-bit PNG (grey), `.npy` (h, w) | any unit and offset; 0 where unknown |

Normals are in camera axes: x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.capture.photos.undistortion import remap_tables
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.imaging.image_process import read_pixels
from gsbake.imaging.npy import read_npy
from gsbake.memory_budget import read_bytes
from gsbake.surfels.views import TrainView

Floats = NDArray[np.float32]
#: Folders beside the photos.
FOLDERS = ("normals", "depths")
SUFFIXES = (".npy", ".png")


def prior_files(folder: Path) -> list[str]:
    """Names of the maps in a folder, sorted."""
    return sorted(path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


def _read(path: Path, channels: int) -> Floats:
    """A map (h, w[, 3]) as floats in the units of the file (PNG normals in −1..1); BadInputError for anything else."""
    try:
        if path.suffix.lower() == ".npy":
            values = read_npy(path)
        else:
            values = read_pixels(read_bytes(path), str(path))
            if channels == 3 and values.ndim == 3:
                half = 32767.5 if values.dtype == np.uint16 else 127.5
                values = values[..., 2::-1].astype(np.float32) / half - 1
    except (OSError, ValueError) as error:
        raise BadInputError(f"{path} cannot be read ({error}); give a PNG or a .npy file, or remove it.") from error
    wanted = "an array (height, width, 3) of normals" if channels == 3 else "an array (height, width) of depths"
    if values.ndim != (3 if channels == 3 else 2) or (channels == 3 and values.shape[2] != 3) or not values.size:
        raise BadInputError(f"{path} is not {wanted}; write it again or remove it.")
    return np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _resampled(values: Floats, source: Camera, target: Camera) -> Floats:
    """The map of a photo of `source` as the pinhole `target` sees it, nearest neighbour (no values between two surfaces)."""
    height, width = values.shape[:2]
    x, y = remap_tables(source, target)
    x, y = (x + 0.5) * (width / source.width) - 0.5, (y + 0.5) * (height / source.height) - 0.5
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT), np.float32)


def add_priors(
    views: Sequence[TrainView], cameras: CameraSet, poses: Path, normals: Path | None = None, depths: Path | None = None
) -> list[TrainView]:
    """The views with their maps from the folders `normals` and `depths`; `poses` is the folder of the poses stage with these `cameras`.

    Raises BadInputError for a file that is no such map.
    """
    if normals is None and depths is None:
        return list(views)
    sources = {c.name: c for c in CameraSet.load(poses / "photo_cameras.json").cameras}
    targets = {c.name: c for c in cameras.cameras}
    found: dict[str, dict[str, Path]] = {}
    for kind, folder in zip(FOLDERS, (normals, depths), strict=True):
        if folder is not None:
            found[kind] = {Path(name).stem: folder / name for name in prior_files(folder)}
    out = []
    for view in views:
        target = targets[view.name].scaled(view.pinhole.width, view.pinhole.height)
        maps: dict[str, torch.Tensor] = {}
        for kind, files in found.items():
            if view.name in files and view.name in sources:
                values = _resampled(_read(files[view.name], 3 if kind == "normals" else 1), sources[view.name], target)
                if kind == "normals":
                    maps[kind] = torch.from_numpy(np.rint(127 * np.clip(values, -1, 1)).astype(np.int8).transpose(2, 0, 1).copy())
                else:
                    maps[kind] = torch.from_numpy(np.ascontiguousarray(values))
        out.append(replace(view, normals=maps.get("normals"), depths=maps.get("depths")))
    return out
