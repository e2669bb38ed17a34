"""Depth map fusion: one point per surface location, without the duplicates that later photos see.

Merrell et al., *Real-time visibility-based fusion of depth maps* (ICCV 2007), in the short form of Galliani et al. 2015: depths are
already averaged over consistent views, so a point represents all pixels that see it, and those produce no further points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel
from gsbake.mvs.depth_maps import DepthMap
from gsbake.mvs.ncc import FASTMATH
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.mvs.pyramids import relative_pose

#: A pixel sees the same point when its depth differs by less than this share.
SAME_POINT_TOLERANCE = 0.006


@kernel("f4[:, ::1], f4[::1], f4[:, ::1], f4[::1], f4[:, ::1], u1[:, ::1], f4", fastmath=FASTMATH, error_model="numpy", nogil=True)
def _mark_visible(points: Any, intrinsics: Any, rotation: Any, translation: Any, depth: Any, used: Any, share: Any) -> None:
    """Mark in `used` (h, w) the pixels that see one of `points` (n, 3) of another camera's frame."""
    height, width = depth.shape
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if not pz > np.float32(1e-6):
            continue
        u = intrinsics[0] * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]) / pz + intrinsics[2]
        v = intrinsics[1] * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]) / pz + intrinsics[3]
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        # The nearest four pixels: a view with a higher resolution is then covered without gaps.
        for row in range(max(0, int(v - np.float32(0.5))), min(height, int(v + np.float32(0.5)) + 1)):
            for column in range(max(0, int(u - np.float32(0.5))), min(width, int(u + np.float32(0.5)) + 1)):
                if abs(depth[row, column] - pz) < share * pz:
                    used[row, column] = 1


def fuse(
    maps: Sequence[DepthMap], neighbours: Sequence[Sequence[int]], colour: Callable[[int], NDArray[np.uint8]], tick: Callable[[int], None]
) -> StereoCloud:
    """Fuse all depth maps into one point cloud.

    `neighbours[i]` are the views that may see the same surface as view i, `colour(i)` the photo (h, w, 3) 8-bit sRGB at the map's size;
    `tick(i)` is called after each view.
    """
    depths = [m.depth() for m in maps]
    used = [np.zeros(d.shape, np.uint8) for d in depths]
    parts: list[tuple[NDArray[Any], ...]] = []
    for i, one in enumerate(maps):
        camera = one.camera
        one = one.select(used[i].ravel()[one.pixels] == 0)
        local, plane = one.camera_points(), one.plane.astype(np.float64)
        normal = -plane / np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
        points = local.astype(np.float32)
        for j in neighbours[i]:
            if j > i:
                other = maps[j].camera
                rotation, translation = relative_pose(camera, other)
                intrinsics = np.array([other.fx, other.fy, other.cx, other.cy], np.float32)
                pose = rotation.astype(np.float32), translation.astype(np.float32)
                _mark_visible(points, intrinsics, *pose, depths[j], used[j], np.float32(SAME_POINT_TOLERANCE))
        parts.append(
            (
                (local - camera.t) @ camera.R,
                normal @ camera.R,
                colour(i).reshape(-1, 3)[one.pixels] if len(one) else np.zeros((0, 3), np.uint8),
                local[:, 2] / camera.fx,
                one.confidence.astype(np.float64),
                one.views,
            )
        )
        tick(i)
    return StereoCloud(*(np.concatenate(column) for column in zip(*parts, strict=True)))
