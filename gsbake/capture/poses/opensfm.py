"""`reconstruction.json` of OpenSfM and OpenDroneMap (opensfm.org, *Dataset structure* and *Camera models*).

The file lists reconstructions that share no frame of reference; the one with most shots is read. A shot's `rotation` is an angle-axis
vector that leads from the world to the camera (x right, y down, z forward). Focal lengths and principal points are in units of the
longer side of the photo, the latter from its centre. Distortion is OpenCV's. Fisheye, spherical and dual cameras are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from gsbake.capture.poses.frames import GivenPoses, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import MAX_FRAMES, Coefficient, Focal, Size, Strict, Vector, read_json
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.text import missing_list

#: Models with one focal length, and models with two and a principal point.
_MODELS = ("perspective", "simple_radial", "radial", "brown")


class _Lens(Strict):
    projection_type: str = Field(max_length=100)
    width: Size
    height: Size
    focal: Focal | None = None
    focal_x: Focal | None = None
    focal_y: Focal | None = None
    c_x: Coefficient = 0.0
    c_y: Coefficient = 0.0
    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    k3: Coefficient = 0.0
    p1: Coefficient = 0.0
    p2: Coefficient = 0.0


class _Shot(Strict):
    rotation: Vector
    translation: Vector
    camera: str


class _Point(Strict):
    coordinates: Vector
    color: Annotated[list[Annotated[float, Field(ge=0, le=255)]], Field(min_length=3, max_length=3)]


class _Reconstruction(Strict):
    cameras: dict[str, _Lens]
    shots: dict[str, _Shot] = Field(max_length=MAX_FRAMES)
    points: dict[str, _Point] = {}


def read_opensfm(path: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses and points of a reconstruction.json for the photos in `sizes`.

    Raises BadInputError for an invalid file, a value that is not finite or out of bounds, and a camera that is not perspective.
    """
    found = max(read_json(path, list[_Reconstruction], "reconstruction.json of OpenSfM"), key=lambda r: len(r.shots), default=None)
    if found is None or not found.shots:
        raise BadInputError(f"{path} holds no reconstruction with a photo; run OpenSfM's reconstruction again.")
    if lost := [f"{shot.camera} of {name}" for name, shot in found.shots.items() if shot.camera not in found.cameras]:
        raise BadInputError(f"{len(lost)} frames in {path} have a camera that is not in the file ({missing_list(lost)}); export it again.")
    if lacking := [name for name, lens in found.cameras.items() if lens.focal is None and lens.focal_x is None]:
        raise BadInputError(f"{len(lacking)} cameras in {path} have no focal length, focal or focal_x ({missing_list(lacking)}).")
    frames = []
    for name, shot in found.shots.items():
        turn = Rotation.from_rotvec(shot.rotation).as_matrix()
        R, t = checked_rigid(turn, np.array(shot.translation), name, str(path))
        frames.append((name, Camera(name=name, R=R, t=t, **_intrinsics(found.cameras[shot.camera], name, path))))
    cameras, missing = match_cameras(frames, sizes, str(path))
    points = list(found.points.values())
    if not points:
        return GivenPoses(cameras, missing)
    colours: Any = np.array([p.color for p in points]).round().astype(np.uint8)
    return GivenPoses(cameras, missing, np.array([p.coordinates for p in points]), colours)


def _intrinsics(lens: _Lens, name: str, path: Path) -> dict[str, Any]:
    """Size, focal lengths and principal point in pixels, and distortion."""
    if lens.projection_type not in _MODELS:
        raise BadInputError(f"The camera of frame {name} in {path} is of the type {lens.projection_type}; undistort the photos first.")
    side = max(lens.width, lens.height)
    fx = lens.focal if lens.focal_x is None else lens.focal_x
    fy = fx if lens.focal_y is None else lens.focal_y
    assert fx is not None and fy is not None, "checked for all cameras at once"
    k = lens.k1, lens.k2, lens.p1, lens.p2, lens.k3
    return {
        "width": round(lens.width),
        "height": round(lens.height),
        "fx": fx * side,
        "fy": fy * side,
        "cx": lens.width / 2 + lens.c_x * side,
        "cy": lens.height / 2 + lens.c_y * side,
        "distortion": k if any(k) else (),
    }
