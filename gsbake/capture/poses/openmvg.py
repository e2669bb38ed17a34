"""`sfm_data.json` of OpenMVG (openmvg.readthedocs.io, *SfM* and *Camera models*).

Views name a photo, its intrinsics and its pose; poses are a world→camera rotation (x right, y down, z forward) and the camera's centre.
Pixel centres have whole coordinates, so that half a pixel is added to the principal point. Radial distortion has one or three
coefficients, the Brown model three and OpenCV's two tangential ones; fisheye and spherical cameras are refused.

The file is written by the library cereal, which names a camera's class at its first occurrence only: the keys of a camera tell its model.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from pydantic import Field

from gsbake.capture.poses.frames import GivenPoses, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import MAX_FRAMES, Coefficient, Focal, Principal, Size, Strict, Vector, read_json
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.text import missing_list

_Body = TypeVar("_Body")


class _Pointer(Strict, Generic[_Body]):
    data: _Body


class _Pointed(Strict, Generic[_Body]):
    ptr_wrapper: _Pointer[_Body]


class _Entry(Strict, Generic[_Body]):
    key: int
    value: _Body


class _View(Strict):
    filename: str = Field(min_length=1, max_length=4096)
    local_path: str = Field("", max_length=4096)
    id_intrinsic: int
    id_pose: int


class _Pinhole(Strict):
    width: Size | None = None
    height: Size | None = None
    focal_length: Focal | None = None
    principal_point: Annotated[list[Principal], Field(min_length=2, max_length=2)] | None = None


class _Lens(_Pinhole):
    """A camera, whose pinhole stands in `value0` or, in older files, beside its distortion."""

    value0: _Pinhole | None = None
    disto_k1: Annotated[list[Coefficient], Field(min_length=1, max_length=1)] | None = None
    disto_k3: Annotated[list[Coefficient], Field(min_length=3, max_length=3)] | None = None
    disto_t2: Annotated[list[Coefficient], Field(min_length=5, max_length=5)] | None = None
    fisheye: list[Coefficient] | None = None


class _Pose(Strict):
    rotation: Annotated[list[Vector], Field(min_length=3, max_length=3)]
    center: Vector


class _SfmData(Strict):
    views: list[_Entry[_Pointed[_View]]] = Field(max_length=MAX_FRAMES)
    intrinsics: list[_Entry[_Pointed[_Lens]]] = Field(max_length=MAX_FRAMES)
    extrinsics: list[_Entry[_Pose]] = Field(max_length=MAX_FRAMES)


def read_openmvg(path: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a sfm_data.json for the photos in `sizes`; views without a pose are left out.

    Raises BadInputError for an invalid file, a value that is not finite or out of bounds, a matrix that is no rotation, and a camera that
    is not a pinhole with radial or Brown distortion.
    """
    body = read_json(path, _SfmData, "sfm_data.json of OpenMVG")
    lenses = {entry.key: entry.value.ptr_wrapper.data for entry in body.intrinsics}
    poses = {entry.key: entry.value for entry in body.extrinsics}
    posed = [view for entry in body.views if (view := entry.value.ptr_wrapper.data).id_pose in poses]
    if lost := [view.filename for view in posed if view.id_intrinsic not in lenses]:
        raise BadInputError(f"The intrinsics of {len(lost)} views in {path} are not in the file ({missing_list(lost)}); export it again.")
    if lacking := [f"{view.filename}: {field}" for view in posed for field in _absent(lenses[view.id_intrinsic])]:
        raise BadInputError(f"{path} lacks fields of cameras ({missing_list(lacking)}); export it again.")
    frames = []
    for view in posed:
        pose = poses[view.id_pose]
        R, centre = checked_rigid(np.array(pose.rotation), np.array(pose.center), view.filename, str(path))
        camera = Camera(name=view.filename, R=R, t=-R @ centre, **_intrinsics(lenses[view.id_intrinsic], view.filename, path))
        frames.append((f"{view.local_path}/{view.filename}" if view.local_path else view.filename, camera))
    if not frames:
        raise BadInputError(f"{path} holds no view with a pose; give the file that OpenMVG wrote after its reconstruction.")
    cameras, missing = match_cameras(frames, sizes, str(path))
    return GivenPoses(cameras, missing)


def _absent(lens: _Lens) -> list[str]:
    """Fields of its size that a camera lacks."""
    pinhole = lens.value0 or lens
    return [name for name in ("width", "height") if getattr(pinhole, name) is None]


def _intrinsics(lens: _Lens, name: str, path: Path) -> dict[str, Any]:
    """Size, focal length, principal point and OpenCV distortion."""
    pinhole = lens.value0 or lens
    if lens.fisheye is not None or pinhole.focal_length is None or pinhole.principal_point is None:
        raise BadInputError(f"The camera of view {name} in {path} is no pinhole (it is fisheye or spherical); undistort the photos first.")
    assert pinhole.width is not None and pinhole.height is not None, "checked for all cameras at once"
    k1, k2, k3, p1, p2 = lens.disto_t2 or [*(lens.disto_k3 or [*(lens.disto_k1 or [0.0]), 0.0, 0.0]), 0.0, 0.0]
    k = k1, k2, p1, p2, k3
    return {
        "width": round(pinhole.width),
        "height": round(pinhole.height),
        "fx": pinhole.focal_length,
        "fy": pinhole.focal_length,
        "cx": pinhole.principal_point[0] + 0.5,
        "cy": pinhole.principal_point[1] + 0.5,
        "distortion": k if any(k) else (),
    }
