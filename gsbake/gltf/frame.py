"""The asset frame: glTF's right-handed +Y up axes, and the origin.

The world is Z-up; (x, y, z) maps to (x, z, −y), so Blender's front (−Y) is glTF's front (+Z). Given poses keep their origin; that of solved
poses is arbitrary, so the origin moves to the bottom centre of the object, unless the settings say where it is.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet, Similarity

#: World (Z-up) to glTF (Y-up).
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def asset_frame(cameras: CameraSet, position: NDArray[Any], origin: Literal["auto", "bottom", "centre"] = "auto") -> Similarity:
    """The map from the unit frame of `cameras` to the asset frame; `position` (v, 3) are the mesh's vertices in the unit frame.

    `origin`: the middle of the bottom or of the whole of their box; "auto" keeps that of given poses, and is else the bottom.
    """
    to_gltf = cameras.to_world.then(Similarity(1.0, Y_UP, np.zeros(3)))
    if cameras.poses == "given" and origin == "auto":
        return to_gltf
    placed = to_gltf.apply(np.asarray(position, np.float64))
    low, high = placed.min(0), placed.max(0)
    place = (low + high) / 2
    if origin != "centre":
        place[1] = low[1]
    return to_gltf.then(Similarity(1.0, np.eye(3), -place))


def transforms_json(cameras: CameraSet, frame: Similarity, sources: dict[str, str]) -> dict[str, Any]:
    """nerfstudio's `transforms.json` with the cameras in the asset frame.

    `frame` maps the cameras' frame to the asset frame; `sources` maps each camera's name to the file name of its photo. Matrices are
    camera-to-asset with OpenGL axes; intrinsics are per frame.
    """
    frames = []
    for camera in cameras.cameras:
        moved = camera.moved(frame)
        frames.append(
            {
                "file_path": sources.get(camera.name, camera.name),
                "w": camera.width,
                "h": camera.height,
                "fl_x": camera.fx,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "transform_matrix": moved.camera_to_world_opengl().tolist(),
            }
        )
    return {
        "camera_model": "PINHOLE",
        "frame": "glTF: right-handed, +Y up; OpenGL camera axes; intrinsics of the undistorted photos",
        "scale": "metres" if cameras.metric else "unknown",
        "poses": cameras.poses,
        "frames": frames,
    }


def read_transforms_json(path: Path) -> tuple[Camera, ...]:
    """Cameras of the asset's `cameras.json` (nerfstudio format, asset frame, OpenGL axes), in the order of the poses stage's photos.

    Raises BadInputError when the file has another format.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        out = []
        for frame in body["frames"]:
            merged: dict[str, Any] = {**body, **frame}
            rotation, translation = Camera.pose_from_opengl(np.array(frame["transform_matrix"], float))
            fx, fy, cx, cy = (float(merged[k]) for k in ("fl_x", "fl_y", "cx", "cy"))
            out.append(Camera(str(frame["file_path"]), int(merged["w"]), int(merged["h"]), fx, fy, cx, cy, rotation, translation))
    except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
        raise BadInputError(f"{path} is not a camera file in nerfstudio's format ({error}); export the asset again.") from error
    return tuple(out)


def frame_between(unit: tuple[Camera, ...], asset: tuple[Camera, ...]) -> Similarity:
    """The map from the frame of the cameras `unit` to that of the same cameras `asset`. Raises BadInputError when they do not match."""
    if len(unit) != len(asset) or len(unit) < 2:
        raise BadInputError(f"cameras.json of the export lists {len(asset)} cameras for {len(unit)} photos; export the asset again.")
    one, two = (np.array([c.centre for c in cameras]) for cameras in (unit, asset))
    spread_one, spread_two = (float(np.linalg.norm(centres - centres.mean(0))) for centres in (one, two))
    scale = spread_two / max(spread_one, 1e-30)
    frame = Similarity(scale, asset[0].R.T @ unit[0].R)
    moved = replace(frame, translation=two.mean(0) - frame.apply(one).mean(0))
    if np.abs(moved.apply(one) - two).max() > 1e-4 * float(np.linalg.norm(np.ptp(two, axis=0))):
        raise BadInputError("cameras.json of the export does not belong to these poses; export the asset again.")
    return moved
