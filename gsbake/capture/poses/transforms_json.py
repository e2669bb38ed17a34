"""`transforms.json` of NeRF, instant-ngp and nerfstudio: camera-to-world matrices with OpenGL axes.

Intrinsics are global or per frame (which takes precedence): `fl_x, fl_y, cx, cy, w, h, k1..k3, p1, p2`, or only `camera_angle_x`.
The world frame is unchanged; a scale of the matrices is divided out, because it moves no ray. Masks that frames name are found by
`frame_masks.py`. See https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from gsbake.capture.poses.frames import RIGID_TOLERANCE, GivenPoses, PhotoIndex, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import (
    MAX_FRAMES,
    Angle,
    Coefficient,
    Coordinate,
    Focal,
    Principal,
    Size,
    Strict,
    listed_errors,
    read_json_text,
)
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera
from gsbake.text import missing_list

#: Largest scale of matrices, and its inverse the smallest.
MAX_SCALE = 1e6
#: Fields that determine the focal length, at a frame or at the top of the file.
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


class _Intrinsics(Strict):
    """Intrinsics as they may stand at a frame or at the top of the file."""

    camera_model: str | None = Field(None, max_length=100)
    fl_x: Focal | None = None
    fl_y: Focal | None = None
    cx: Principal | None = None
    cy: Principal | None = None
    w: Size | None = None
    h: Size | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    k1: Coefficient | None = None
    k2: Coefficient | None = None
    k3: Coefficient | None = None
    k4: Coefficient | None = None
    p1: Coefficient | None = None
    p2: Coefficient | None = None


class _Frame(_Intrinsics):
    file_path: str = Field(min_length=1, max_length=4096)
    transform_matrix: list[list[Coordinate]] = Field(max_length=4)
    mask_path: str | None = Field(None, max_length=4096)
    depth_file_path: Any = None


class _Transforms(_Intrinsics):
    is_fisheye: bool = False
    frames: list[_Frame] = Field(max_length=MAX_FRAMES)


def _intrinsics(frame: _Frame, shared: _Transforms, size: PhotoSize | None, source: str) -> dict[str, Any]:
    """Width, height, focal lengths, principal point and distortion of a frame."""

    def value(key: str) -> float | None:
        own: float | None = getattr(frame, key)
        common: float | None = getattr(shared, key)
        return common if own is None else own

    name, model = frame.file_path, (frame.camera_model or shared.camera_model or "OPENCV").upper()
    if model not in _MODELS or shared.is_fisheye:
        raise BadInputError(f"The camera model {model} of frame {name} in {source} is not a perspective model; undistort the photos first.")
    if value("k4"):
        raise BadInputError(f"Frame {name} in {source} has a distortion k4, which is not supported; undistort the photos first.")
    width, height = value("w"), value("h")
    if width is None or height is None:
        size = size or PhotoSize(1, 1)  # the frame has no photo, so its size is not used
        width, height = float(size.width), float(size.height)
    fx, fy = value("fl_x"), value("fl_y")
    angle_x, angle_y = value("camera_angle_x"), value("camera_angle_y")
    if fx is None and angle_x is not None:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if fy is None:
        fy = 0.5 * height / math.tan(0.5 * angle_y) if angle_y is not None and fx is None else fx
    if fx is None:
        fx = fy
    assert fx is not None and fy is not None, "checked for all frames at once"
    cx, cy = value("cx"), value("cy")
    k = tuple(value(key) or 0.0 for key in ("k1", "k2", "p1", "p2", "k3"))
    if not k[4]:
        k = k[:4]
    return {
        "width": round(width),
        "height": round(height),
        "fx": fx,
        "fy": fy,
        "cx": 0.5 * width if cx is None else cx,
        "cy": 0.5 * height if cy is None else cy,
        "distortion": k if any(k) else (),
    }


def _frame_name(error: ValidationError) -> str:
    """The number of the frame that an error is about (from 1), for the start of a message; empty when it is about none."""
    location = error.errors(include_url=False, include_context=False, include_input=False)[0]["loc"]
    return f"Frame {location[1] + 1}: " if len(location) > 1 and isinstance(location[1], int) else ""


def read_transforms(path: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a transforms.json for the photos in `sizes`.

    Raises BadInputError for an invalid file, a value that is not finite or out of bounds, a matrix that shears or mirrors, and a fisheye
    camera.
    """
    try:
        body = _Transforms.model_validate_json(read_json_text(path))
    except ValidationError as error:
        raise BadInputError(f"{_frame_name(error)}{path} is not a valid transforms.json ({listed_errors(error)}).") from error
    unknown = [frame.file_path for frame in body.frames if not any(getattr(f, key) for f in (frame, body) for key in _FOCAL)]
    if unknown:
        raise BadInputError(f"{len(unknown)} frames in {path} have no focal length, fl_x or camera_angle_x ({missing_list(unknown)}).")
    frames, index, scales = [], PhotoIndex(sizes), []
    for frame in body.frames:
        file, rows = frame.file_path, frame.transform_matrix
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
            raise BadInputError(f"The transform_matrix of frame {file} in {path} is not 4x4.")
        matrix = np.asarray(rows, float)
        if len(rows) == 4 and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
            raise BadInputError(f"The pose of frame {file} in {path} is no rigid motion: its last row is {matrix[3].tolist()}.")
        scale = _scale(matrix[:3, :3])
        scales.append(scale)
        rot, centre = checked_rigid(matrix[:3, :3] / scale, matrix[:3, 3], file, str(path))
        R, t = Camera.pose_from_opengl(np.concatenate([rot, centre[:, None]], 1))
        photo = index.match(file)
        inner = _intrinsics(frame, body, None if photo is None else sizes[photo], str(path))
        frames.append((file, Camera(name=file, R=R, t=t, **inner)))
    cameras, missing = match_cameras(frames, sizes, str(path))
    return GivenPoses(cameras, missing, notes=(*_scale_note(scales, path), *_depth_note(body, path)))


def _scale(linear: Array) -> float:
    """The scale of a matrix (3, 3): the cube root of its determinant; 1 within rounding, and for mirrors and scales beyond all units."""
    scale = float(np.cbrt(max(np.linalg.det(linear), 0.0)))
    return scale if 1 / MAX_SCALE < scale < MAX_SCALE and abs(scale**2 - 1) > RIGID_TOLERANCE else 1.0


def _scale_note(scales: Sequence[float], path: Path) -> Iterator[tuple[str, str, str]]:
    """What is said about matrices with a scale."""
    scaled = [scale for scale in scales if scale != 1]
    if scaled:
        low, high = min(scaled), max(scaled)
        amount = f"{low:.4g}" if high < 1.01 * low else f"{low:.4g} to {high:.4g}"
        yield "scale of the matrices", "divided out", f"{len(scaled)} of {len(scales)} in {path.name} carry a scale of {amount}"


def _depth_note(body: _Transforms, path: Path) -> Iterator[tuple[str, str, str]]:
    """What is said about depth maps that frames name."""
    count = sum(frame.depth_file_path is not None for frame in body.frames)
    if count:
        where = "depth maps are read from a folder depths/, where coupling.prior_depths is set"
        yield "depth_file_path", "not used", f"{count} frames of {path.name} have one; {where}"
