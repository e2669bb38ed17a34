"""Depth search range of a pixel: between the ray's first and last crossing of the visual hull, or inside the unit ball."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.rays import trilinear
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Array, Camera
from gsbake.kernels.declaration import kernel
from gsbake.mvs.ncc import FASTMATH

Floats = NDArray[np.float32]

#: Radius of the search ball: the unit ball with a margin.
BALL = 1.05
#: The hull is dilated by this many cells: the uncertainty of masks and poses.
MARGIN = 1.0


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def _crossing(field: Any, origin: Any, direction: Any, start: float, stop: float, margin: float) -> float:
    """First parameter from `start` towards `stop` where the field, in cells, falls below `margin`; −1 when it never does."""
    t = start
    sign = 1.0 if stop > start else -1.0
    speed = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    while (stop - t) * sign > 0:
        value = trilinear(field, origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
        if value < margin:
            return t
        # The field is a lower bound of the distance; beyond the grid it is unknown, so steps are limited there too.
        t += sign * max(0.5, 0.8 * min(value - margin, 4.0)) / speed
    return -1.0


@kernel("u1[:, ::1], f8[:, :, ::1], f8[::1], f8, f4[:, :, ::1], f8[::1], f8, f8, f8[:, ::1], f8[:, ::1]", error_model="numpy", nogil=True)
def _bounds(
    inside: Any, rays: Any, centre: Any, ball: float, field: Any, lower: Any, cell: float, margin: float, near: Any, far: Any
) -> None:
    """Fill `near`, `far` (h, w) z-depths; 0 where the ray misses. `field` is in cells; when it is empty the ball is the bound."""
    direction = np.zeros(3)
    origin = np.zeros(3)
    for v in range(inside.shape[0]):
        for u in range(inside.shape[1]):
            near[v, u] = 0
            far[v, u] = 0
            if inside[v, u] == 0:
                continue
            a = b = 0.0
            c = -ball * ball
            for k in range(3):
                a += rays[v, u, k] * rays[v, u, k]
                b += rays[v, u, k] * centre[k]
                c += centre[k] * centre[k]
            root = b * b - a * c
            if not root > 0:
                continue
            first, last = max((-b - np.sqrt(root)) / a, 1e-3), (-b + np.sqrt(root)) / a
            if not last > first:
                continue
            if field.shape[0] > 0:
                for k in range(3):
                    origin[k] = (centre[k] - lower[k]) / cell - 0.5
                    direction[k] = rays[v, u, k] / cell
                start = _crossing(field, origin, direction, first, last, margin)
                if start < 0:
                    continue
                last = _crossing(field, origin, direction, last, first, margin)
                first = start
                if not last > first:
                    continue
            near[v, u] = first
            far[v, u] = last


def depth_bounds(camera: Camera, inside: NDArray[np.uint8], hull: Hull | None) -> tuple[Floats, Floats]:
    """Minimum and maximum inverse z-depth (h, w) of each pixel, both 0 where there is no surface.

    `inside` (h, w) is the mask, non-zero where the object may be; without a hull the bound is the ball.
    """
    near, far = np.zeros(inside.shape), np.zeros(inside.shape)
    if hull is None:
        field, lower, cell = np.zeros((0, 0, 0), np.float32), np.zeros(3), 1.0
    else:
        field, lower, cell = (hull.field / hull.cell).astype(np.float32), np.asarray(hull.lower, float), float(hull.cell)
    _bounds(inside, camera.rays(), np.asarray(camera.centre, float), BALL, field, lower, cell, MARGIN, near, far)
    hit = far > 0
    low = np.where(hit, 1 / np.where(hit, far, 1), 0)
    high = np.where(hit, 1 / np.where(hit, near, 1), 0)
    return low.astype(np.float32), high.astype(np.float32)


def seed_depths(camera: Camera, points: Array, reach: int) -> Floats:
    """Inverse z-depth (h, w) of the nearest of `points` (k, 3) in each pixel, extended to pixels up to `reach` away; 0 = none."""
    import cv2

    out = np.zeros((camera.height, camera.width), np.float32)
    if len(points) == 0:
        return out
    pixel, z = camera.project(points)
    column, row = np.floor(pixel).astype(np.int64).T
    visible = (z > 1e-3) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    np.maximum.at(out, (row[visible], column[visible]), (1 / z[visible]).astype(np.float32))
    if not out.any():
        return out
    distance, label = cv2.distanceTransformWithLabels((out == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    values = np.zeros(int(label.max()) + 1, np.float32)
    here = out > 0
    values[label[here]] = out[here]
    return np.where(distance <= reach, values[label], 0).astype(np.float32)
