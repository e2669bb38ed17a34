"""`transforms.json` of NeRF, instant-ngp and nerfstudio: camera-to-world matrices with OpenGL axes.

Intrinsics stand at the top or in a frame (which wins): `fl_x, fl_y, cx, cy, w, h, k1..k3, p1, p2`, or only `camera_angle_x`.
The world is kept as it came. See https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.poses.frames import Given, PhotoSize, collect, match_frame, rigid
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def _intrinsics(frame: Mapping[str, Any], shared: Mapping[str, Any], name: str, size: PhotoSize | None, source: str) -> dict[str, Any]:
    def value(*keys: str) -> float | None:
        for holder in (frame, shared):
            for key in keys:
                if holder.get(key) is not None:
                    return float(holder[key])
        return None

    model = str(frame.get("camera_model", shared.get("camera_model", "OPENCV"))).upper()
    if model not in _MODELS or shared.get("is_fisheye"):
        raise BadInputError(f"The camera model {model} of frame {name} in {source} is not a perspective one; undistort the photos first.")
    if value("k4"):
        raise BadInputError(f"Frame {name} in {source} has a distortion k4, which is not supported; undistort the photos first.")
    width, height = value("w"), value("h")
    if width is None or height is None:
        if size is None:  # the frame has no photo, so that its size does not matter
            size = PhotoSize(1, 1)
        width, height = float(size.width), float(size.height)
    fx, fy = value("fl_x"), value("fl_y")
    angle_x, angle_y = value("camera_angle_x"), value("camera_angle_y")
    if fx is None and angle_x is not None:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if fy is None:
        fy = 0.5 * height / math.tan(0.5 * angle_y) if angle_y is not None and fx is None else fx
    if fx is None:
        fx = fy
    if fx is None or fy is None:
        raise BadInputError(f"Frame {name} in {source} has no focal length (fl_x or camera_angle_x).")
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


def read_transforms(path: Path, sizes: Mapping[str, PhotoSize]) -> Given:
    """Poses of a transforms.json for the photos whose `sizes` are given.

    Raises BadInputError for what is no such file, for NaN, for a matrix that is no rigid motion, and for a fisheye camera.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        listed = body["frames"]
        pairs = [(str(f["file_path"]), f) for f in listed]
    except (ValueError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path} is no transforms.json with frames that name their file_path ({error}).") from error
    frames = []
    for file, frame in pairs:
        try:
            matrix = np.asarray(frame["transform_matrix"], float)
        except (KeyError, TypeError, ValueError) as error:
            raise BadInputError(f"Frame {file} in {path} has no numeric transform_matrix.") from error
        if matrix.shape not in ((4, 4), (3, 4)):
            raise BadInputError(f"The transform_matrix of frame {file} in {path} is {matrix.shape}, not 4x4.")
        if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
            raise BadInputError(f"The pose of frame {file} in {path} is no rigid motion: its last row is {matrix[3].tolist()}.")
        rot, centre = rigid(matrix[:3, :3], matrix[:3, 3], file, str(path))
        R, t = Camera.pose_from_opengl(np.concatenate([rot, centre[:, None]], 1))
        photo = match_frame(file, sizes)
        inner = _intrinsics(frame, body, file, None if photo is None else sizes[photo], str(path))
        frames.append((file, Camera(name=file, R=R, t=t, **inner)))
    cameras, missing = collect(frames, sizes, str(path))
    return Given(cameras, missing)
