"""The scene after poses: cameras and points in the cameras' frame, the region, and the help for picking points in two photos."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from starlette.responses import Response

from gsbake.capture.posed_photos import REGION, PosedPhotos
from gsbake.config.lengths import PixelPosition
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.region import Region
from gsbake.scale.triangulation import PickedPhotos
from gsbake.studio.answers import Call
from gsbake.studio.outputs import entries, required
from gsbake.studio.workspace import NotFoundError

#: Most points of the scene; points of an epipolar line, and how far it reaches in multiples of the object's radius around the object.
MAX_POINTS, LINE_POINTS, LINE_REACH = 40_000, 48, 3.0


def scene(call: Call) -> dict[str, Any]:
    """Cameras in the world (Z-up, the frame of `--region` and `--up`), the object's ball, the region in use; no cameras before poses."""
    try:
        ingest, poses = required(call.capture, "ingest", "poses")
    except NotFoundError:
        return {"cameras": []}
    posed = CameraSet.load(poses.folder / "cameras.json")
    sources = {entry["name"]: entry for entry in entries(ingest)}
    cameras = []
    for camera in posed.cameras:
        moved = camera.moved(posed.to_world)
        corners = np.array([(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)], float)
        rays = np.column_stack([(corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(4)]) @ moved.R
        entry = sources.get(camera.name, {})
        size = {"width": entry.get("source_width", camera.width), "height": entry.get("source_height", camera.height)}
        cameras.append({
            "name": camera.name, "source": entry.get("source", camera.name), "size": size, "centre": moved.centre.tolist(),
            "corners": rays.tolist(),
        })  # fmt: skip
    region = None
    with suppress(BadInputError, OSError):
        region = Region.read(poses.folder / REGION).numbers
    return {
        "cameras": cameras, "centre": posed.to_world.translation.tolist(), "radius": posed.to_world.scale, "region": region,
        "poses": posed.poses, "points": PosedPhotos(poses.folder, posed).points() is not None,
    }  # fmt: skip


def points(call: Call) -> Response:
    """Tie points in the world: n × 3 single-precision coordinates, then n × 3 bytes of colour."""
    (poses,) = required(call.capture, "poses")
    posed = PosedPhotos.open(poses.folder)
    found = posed.points()
    if found is None:
        raise NotFoundError(f"{call.capture.name} has no tie points.")
    position, colour = found
    step = max(1, -(-len(position) // MAX_POINTS))
    placed = np.ascontiguousarray(posed.cameras.to_world.apply(position[::step]), "<f4")
    return Response(placed.tobytes() + np.ascontiguousarray(colour[::step]).tobytes(), media_type="application/octet-stream")


def epipolar(call: Call) -> dict[str, Any]:
    """Where a point at pixel x, y of one photo can lie in another: the curve in pixels of its file."""
    ingest, poses = required(call.capture, "ingest", "poses")
    listed = entries(ingest)
    posed = CameraSet.load(poses.folder / "cameras.json")
    cameras = {camera.name: camera for camera in CameraSet.load(poses.folder / "photo_cameras.json").cameras}
    x, y = (float(call.field(name, int | float)) for name in ("x", "y"))  # type: ignore[arg-type]
    picked = PickedPhotos(cameras, listed)
    ray = picked.ray(PixelPosition(str(call.field("photo", str)), x, y))
    entry = next((entry for entry in listed if entry["source"] == call.field("other", str)), None)
    camera = None if entry is None else cameras.get(entry["name"])
    if entry is None or camera is None:
        raise BadInputError("The other photo was not registered and has no camera; use another photo.")
    middle, reach = float((posed.to_world.translation - ray.origin) @ ray.direction), LINE_REACH * posed.to_world.scale
    depths = np.linspace(max(middle - reach, 0.02 * max(middle, reach)), middle + reach, LINE_POINTS)
    line = project(camera, ray.origin + depths[:, None] * ray.direction)
    scale = np.array([entry["source_width"] / camera.width, entry["source_height"] / camera.height])
    return {"line": [[round(float(a), 2), round(float(b), 2)] for a, b in line * scale]}


def project(camera: Camera, world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (m, 2) of the points (n, 3) in front of a camera, with its distortion."""
    ahead = world[(world @ camera.R.T + camera.t)[:, 2] > 1e-6]
    if not len(ahead):
        return np.zeros((0, 2))
    pixels, _ = cv2.projectPoints(ahead, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, np.array(camera.distortion or (0.0,) * 4))
    return np.asarray(pixels, np.float64).reshape(-1, 2)
