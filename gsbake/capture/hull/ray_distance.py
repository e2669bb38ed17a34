"""How far inside or outside the visual hull the rays of a photo pass: the hull's silhouette with subpixel precision.

The hull's field is a signed distance, so sphere tracing (Hart, *Sphere tracing*, The Visual Computer 1996) finds its least value on a ray
in few steps. Negative: the ray enters the hull, and goes that deep at most. Positive: it passes the hull at that distance.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.rays import trilinear
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

#: Least and greatest step along a ray in cells: finer steps find no other minimum of a trilinear field, wider ones may skip a thin part.
_LEAST_STEP, _GREATEST_STEP = 0.5, 4.0
#: Edge of the squares of pixels whose middle is tried first.
_SQUARE = 4


@nb.njit(error_model="numpy", cache=True)
def _least_on_ray(field: Any, origin: Any, ray: Any, cell: float, focal: float, deepest: float) -> float:
    """Least value on one `ray` (3,), in cells per unit of depth from `origin`, in pixels; the ray ends below `deepest`."""
    first, last, speed = 1e-6, 1e30, 0.0
    for axis in range(3):
        speed += ray[axis] ** 2
        if abs(ray[axis]) > 1e-12:
            a, b = -origin[axis] / ray[axis], (field.shape[axis] - 1 - origin[axis]) / ray[axis]
            first, last = max(first, min(a, b)), min(last, max(a, b))
        elif not 0 < origin[axis] < field.shape[axis] - 1:
            last = 0.0
    speed = np.sqrt(speed)
    least = np.inf
    while first < last:
        value = trilinear(field, origin[0] + first * ray[0], origin[1] + first * ray[1], origin[2] + first * ray[2])
        least = min(least, value * cell * focal / first)
        if least < deepest:
            break
        first += max(_LEAST_STEP, min(value, _GREATEST_STEP)) / speed
    return least


@kernel("i8, i8, f4[:, :, ::1], f8[:, :, ::1], f8[::1], f8, f8, f8, f4[:, ::1]", nogil=True, error_model="numpy")
def _least_distance(
    lo: int, hi: int, field: Any, rays: Any, origin: Any, cell: float, focal: float, greatest: float, out: Any
) -> None:
    """Kernel of `ray_distance` for the rows lo..hi of squares; `field` in cells, `rays` (h, w, 3) and `origin` (3,) in its lattice."""
    height, width, _ = rays.shape
    reach = greatest + 0.75 * _SQUARE  # from the middle of a square to its corners
    for square in range(lo, hi):
        top = square * _SQUARE
        bottom = min(top + _SQUARE, height)
        for left in range(0, width, _SQUARE):
            right = min(left + _SQUARE, width)
            middle = _least_on_ray(field, origin, rays[(top + bottom) // 2, (left + right) // 2], cell, focal, -reach)
            for v in range(top, bottom):
                for u in range(left, right):
                    out[v, u] = middle if abs(middle) > reach else _least_on_ray(field, origin, rays[v, u], cell, focal, -greatest)


def ray_distance(hull: Hull, camera: Camera, greatest: float) -> NDArray[np.float32]:
    """Least signed distance (h, w) between the hull's surface and the ray of each pixel, in pixels of the pinhole `camera`.

    Negative where the ray enters the hull, infinite where it misses the hull's grid. Exact up to ± `greatest` pixels; of values beyond only
    that and the sign are known, as a distance changes by at most one pixel between neighbouring pixels.
    """
    field = (hull.field / hull.cell).astype(np.float32)
    origin = (np.asarray(camera.centre, float) - hull.lower) / hull.cell - 0.5
    rays = camera.rays() / hull.cell
    out = np.empty(rays.shape[:2], np.float32)
    args = (field, rays, origin, float(hull.cell), camera.fx, float(greatest), out)
    run_chunks(lambda lo, hi: _least_distance(lo, hi, *args), -(-len(rays) // _SQUARE))
    return out
