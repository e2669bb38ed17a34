"""Cameras of Polycam's raw data (github.com/PolyCam/polyform): one JSON file per keyframe in `corrected_cameras/` or `cameras/`.

`t_00` … `t_23` are the rows of the camera-to-world matrix of ARKit: camera axes as in OpenGL, world in metres with Y up, which is turned
to Z up here. `fx fy cx cy` are in pixels, whose centres ARKit gives whole coordinates. A file has the name of its photo.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import ValidationError, create_model

from gsbake.capture.poses.frames import GivenPoses, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import MAX_FRAMES, Coordinate, Focal, Principal, Size, Strict, error_lines, read_json_text
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.text import missing_list

_ROWS = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
#: From Y up to Z up.
_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


class _Intrinsics(Strict):
    fx: Focal
    fy: Focal
    cx: Principal
    cy: Principal
    width: Size
    height: Size


_Keyframe = create_model("_Keyframe", __base__=_Intrinsics, **dict.fromkeys(_ROWS, (Coordinate, ...)))  # type: ignore[call-overload]


def read_polycam(folder: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a folder of keyframes for the photos in `sizes`, in metres.

    Raises BadInputError for an invalid file, a value that is not finite or out of bounds, and a matrix that is no rigid motion.
    """
    files = sorted(folder.glob("*.json"))
    if len(files) > MAX_FRAMES:
        raise BadInputError(f"{folder} has more than {MAX_FRAMES} cameras.")
    bodies, wrong = [], []
    for file in files:
        try:
            bodies.append(_Keyframe.model_validate_json(read_json_text(file)))
        except ValidationError as error:
            wrong += [f"{file.name}: {line}" for line in error_lines(error)]
    if wrong:
        raise BadInputError(f"{folder} holds files that are not a valid camera of Polycam ({missing_list(wrong)}).")
    frames = []
    for file, body in zip(files, bodies, strict=True):
        matrix = np.array([getattr(body, name) for name in _ROWS]).reshape(3, 4)
        rotation, centre = checked_rigid(_Z_UP @ matrix[:, :3], _Z_UP @ matrix[:, 3], file.stem, str(folder))
        R, t = Camera.pose_from_opengl(np.column_stack([rotation, centre]))
        size = round(body.width), round(body.height)
        frames.append((file.stem, Camera(file.stem, *size, body.fx, body.fy, body.cx + 0.5, body.cy + 0.5, R, t)))
    cameras, missing = match_cameras(frames, sizes, str(folder))
    return GivenPoses(cameras, missing)
