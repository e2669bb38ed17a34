"""Numba kernel of photometric refinement: displacement of a surface point along its normal that maximises NCC.

The patch lies in the tangent plane of the point and is compared through that plane's homography (`gsbake.mvs.ncc`). A
parabola through the summed 1 − NCC of the best views at three planes (the current one and one step to either side along the normal) has
its minimum at the displacement; its curvature and height give the certainty.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbake.kernels.declaration import kernel
from gsbake.mvs.ncc import FASTMATH, OUT_OF_VIEW_COST, RADIUS, ncc_cost, patch_statistics

#: Minimum variance of a patch (grey levels squared): twice the camera's noise.
MIN_VARIANCE = np.float32(3.0)
#: Maximum cost of a view that shows the same surface.
MAX_COST = np.float32(0.4)


@kernel(
    "i8, i8, f4[:, ::1], f4[:, ::1], i8[::1], f4[::1], u1[:, ::1], u1[:, ::1], f4[::1], UniTuple(f4[::1], 4), "
    "Tuple((f4[:, ::1], u4[::1], i8[::1], i8[:, ::1])), i8, f4[::1], f4[::1], f4[::1]",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def measure_displacements(
    start: int, stop: int, points: Any, normals: Any, visible: Any, steps: Any, grey: Any, inside: Any, intrinsics: Any, pattern: Any,
    views: Any, best_of: int, displacement: Any, curvatures: Any, cost: Any,
) -> None:  # fmt: skip
    """Fill `displacement` (n,) in world units, `curvatures` (n,) and `cost` (n,) for the points start..stop of one reference photo.

    `points`, `normals` (n, 3) in the reference camera's frame; `visible` (n,) one bit per view that sees the point; `steps` (n,) the
    step along the normal in world units; photos, intrinsics, pattern and views as in `gsbake.mvs.ncc`. `curvatures` are second derivatives
    of the summed cost per step², `cost` the mean over the best views, at most `best_of`. Without a match `cost` is 1 and the curvature 0.
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    count_views = views[0].shape[0]
    costs = np.empty(count_views, np.float32)
    sx, sy = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    height, width = grey.shape[0] - 2 * RADIUS, grey.shape[1] - 2 * RADIUS
    one, half, two = np.float32(1), np.float32(0.5), np.float32(2)
    for k in range(start, stop):
        displacement[k], curvatures[k], cost[k] = np.float32(0), np.float32(0), one
        z = points[k, 2]
        u = int(np.floor(points[k, 0] / z * intrinsics[0] + intrinsics[2] + half))
        v = int(np.floor(points[k, 1] / z * intrinsics[1] + intrinsics[3] + half))
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        if patch_statistics(grey, inside, v, u, pattern, weight, moment) < MIN_VARIANCE:
            continue
        x, y = (np.float32(u) - intrinsics[2]) * sx, (np.float32(v) - intrinsics[3]) * sy
        n0, n1, n2 = normals[k, 0], normals[k, 1], normals[k, 2]
        plane_distance = n0 * points[k, 0] + n1 * points[k, 1] + n2 * z
        inverse = one / plane_distance
        for j in range(count_views):
            costs[j] = OUT_OF_VIEW_COST
            if (visible[k] >> j) & 1:
                costs[j] = ncc_cost(j, n0 * inverse, n1 * inverse, n2 * inverse, x, y, sx, sy, pattern, weight, moment, views)
        selected, count, cost_centre = 0, 0, np.float32(0)
        for _ in range(best_of):
            best = -1
            for j in range(count_views):
                if (selected >> j) & 1 == 0 and costs[j] < MAX_COST and (best < 0 or costs[j] < costs[best]):
                    best = j
            if best < 0:
                break
            selected |= 1 << best
            cost_centre += costs[best]
            count += 1
        if count == 0:
            continue
        inner, outer = one / (plane_distance - steps[k]), one / (plane_distance + steps[k])
        cost_inner, cost_outer = np.float32(0), np.float32(0)
        complete = True
        for j in range(count_views):
            if (selected >> j) & 1:
                a = ncc_cost(j, n0 * inner, n1 * inner, n2 * inner, x, y, sx, sy, pattern, weight, moment, views)
                b = ncc_cost(j, n0 * outer, n1 * outer, n2 * outer, x, y, sx, sy, pattern, weight, moment, views)
                complete = complete and a < OUT_OF_VIEW_COST and b < OUT_OF_VIEW_COST
                cost_inner += a
                cost_outer += b
        if not complete:
            continue
        cost[k] = cost_centre / np.float32(count)
        curvature = cost_inner + cost_outer - two * cost_centre
        if curvature > np.float32(1e-6):
            curvatures[k] = curvature
            displacement[k] = half * (cost_inner - cost_outer) / curvature * steps[k]
