"""COLMAP sparse models (binary and text), read and written through pycolmap.

COLMAP's cameras are world→camera with OpenCV axes and pixel centres at +.5, as here. See https://colmap.github.io/format.html.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.poses.frames import Given, PhotoSize, collect, rigid
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

#: Camera model → places of its parameters among fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
_LAYOUT = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
}


def intrinsics(model: str, params: Any, where: str) -> dict[str, Any]:
    """fx, fy, cx, cy and OpenCV distortion of a COLMAP camera; BadInputError for models that are not perspective."""
    if model not in _LAYOUT:
        raise BadInputError(f"The camera model {model} in {where} is not supported; undistort the photos first (colmap image_undistorter).")
    values = [float(params[i]) for i in _LAYOUT[model]]
    fx, fy, cx, cy, *k = values
    distortion = tuple(k + [0.0] * (4 - len(k))) if any(k) else ()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": distortion}


def camera_of(image: Any, name: str, where: str) -> Camera:
    """Our camera for an image of a pycolmap reconstruction that has a pose."""
    pose = image.cam_from_world()
    rot, t = rigid(np.asarray(pose.rotation.matrix(), float), np.asarray(pose.translation, float), name, where)
    lens = image.camera
    return Camera(name=name, width=lens.width, height=lens.height, R=rot, t=t, **intrinsics(lens.model_name, lens.params, where))


def read_model(folder: Path, sizes: Mapping[str, PhotoSize]) -> Given:
    """Poses and points of a COLMAP model folder.

    Raises BadInputError for files that are broken or hold NaN, and for camera models that are not perspective.
    """
    model = _open(folder)
    frames = [(im.name, camera_of(im, im.name, str(folder))) for im in model.images.values() if im.has_pose]
    if not frames:
        raise BadInputError(f"The COLMAP model {folder} holds no image with a pose.")
    cameras, missing = collect(frames, sizes, str(folder))
    points, colours = cloud(model)
    return Given(cameras, missing, points if len(points) else None, colours if len(points) else None)


def read_tracks(folder: Path) -> tuple[Any, dict[str, NDArray[np.int64]]]:
    """Points (n, 3) of a COLMAP model folder in its own frame, and the indices of those that each photo shows, by the photo's name
    without suffix. Raises BadInputError for files that are broken."""
    model = _open(folder)
    index = {name: k for k, name in enumerate(model.points3D)}
    points = np.array([p.xyz for p in model.points3D.values()], float).reshape(-1, 3)
    seen = {
        Path(image.name).stem: np.array([index[p.point3D_id] for p in image.points2D if p.has_point3D()], np.int64)
        for image in model.images.values()
    }
    return points, seen


def _open(folder: Path) -> Any:
    from gsbake.capture.sfm.colmap import pycolmap

    try:
        return pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise BadInputError(f"The COLMAP model {folder} cannot be read ({reason}).") from error


def cloud(model: Any) -> tuple[Any, Any]:
    """Points (n, 3) of a reconstruction and their colours (n, 3) 8-bit; those that are not finite are left out."""
    entries = list(model.points3D.values())
    points = np.array([p.xyz for p in entries], float).reshape(-1, 3)
    colours = np.array([p.color for p in entries], np.uint8).reshape(-1, 3)
    good = np.isfinite(points).all(1)
    return points[good], colours[good]
