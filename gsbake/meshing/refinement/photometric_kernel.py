"""How far along its normal a point of a mesh must move for its patch to match other photos best.

The patch lies in the tangent plane of the point and is compared through that plane's homography (`gsbake.mvs.ncc`). Three planes, the
present one and one step to either side along the normal, give a parabola in the summed 1 − NCC of the views that match best: its lowest
place is the displacement, its curvature and height tell how sure it is.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from gsbake.mvs.ncc import FAST, RADIUS, UNSEEN, describe, match

#: Patches with less variance (grey levels squared) have nothing to match: twice the camera's noise.
FLAT = np.float32(3.0)
#: Costs from which on a view does not show the same thing.
WORST = np.float32(0.4)


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def displace(
    start: int, stop: int, points: Any, normals: Any, sees: Any, steps: Any, grey: Any, inside: Any, lens: Any, pattern: Any, views: Any,
    best_of: int, shift: Any, bend: Any, cost: Any,
) -> None:  # fmt: skip
    """Fill `shift` (n,) world units, `bend` (n,) and `cost` (n,) for the points start..stop of one reference photo.

    `points`, `normals` (n, 3) in the reference camera's frame; `sees` (n,) one bit per view that sees the point; `steps` (n,) the step
    along the normal in world units; photos, lens, pattern and views as in `gsbake.mvs.ncc`. `bend` is the second derivative of
    the summed cost per step², `cost` the mean of the at most `best_of` views taken. Where nothing can be said `cost` is 1 and `bend` 0.
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    count_views = views[0].shape[0]
    each = np.empty(count_views, np.float32)
    sx, sy = np.float32(1) / lens[0], np.float32(1) / lens[1]
    height, width = grey.shape[0] - 2 * RADIUS, grey.shape[1] - 2 * RADIUS
    one, half, two = np.float32(1), np.float32(0.5), np.float32(2)
    for k in range(start, stop):
        shift[k], bend[k], cost[k] = np.float32(0), np.float32(0), one
        z = points[k, 2]
        u = int(np.floor(points[k, 0] / z * lens[0] + lens[2] + half))
        v = int(np.floor(points[k, 1] / z * lens[1] + lens[3] + half))
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        if describe(grey, inside, v, u, pattern, weight, moment) < FLAT:
            continue
        x, y = (np.float32(u) - lens[2]) * sx, (np.float32(v) - lens[3]) * sy
        n0, n1, n2 = normals[k, 0], normals[k, 1], normals[k, 2]
        distance = n0 * points[k, 0] + n1 * points[k, 1] + n2 * z
        here = one / distance
        for j in range(count_views):
            each[j] = UNSEEN
            if (sees[k] >> j) & 1:
                each[j] = match(j, n0 * here, n1 * here, n2 * here, x, y, sx, sy, pattern, weight, moment, views)
        chosen, taken, middle = 0, 0, np.float32(0)
        for _ in range(best_of):
            least = -1
            for j in range(count_views):
                if (chosen >> j) & 1 == 0 and each[j] < WORST and (least < 0 or each[j] < each[least]):
                    least = j
            if least < 0:
                break
            chosen |= 1 << least
            middle += each[least]
            taken += 1
        if taken == 0:
            continue
        inner, outer = one / (distance - steps[k]), one / (distance + steps[k])
        before, after = np.float32(0), np.float32(0)
        whole = True
        for j in range(count_views):
            if (chosen >> j) & 1:
                a = match(j, n0 * inner, n1 * inner, n2 * inner, x, y, sx, sy, pattern, weight, moment, views)
                b = match(j, n0 * outer, n1 * outer, n2 * outer, x, y, sx, sy, pattern, weight, moment, views)
                whole = whole and a < UNSEEN and b < UNSEEN
                before += a
                after += b
        if not whole:
            continue
        cost[k] = middle / np.float32(taken)
        curvature = before + after - two * middle
        if curvature > np.float32(1e-6):
            bend[k] = curvature
            shift[k] = half * (before - after) / curvature * steps[k]
