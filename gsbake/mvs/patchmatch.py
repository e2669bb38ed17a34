"""PatchMatch stereo kernels: per-pixel view selection, red-black propagation of planes, random and parabolic refinement.

Bleyer, Rhemann & Rother, *PatchMatch Stereo* (BMVC 2011), with the red-black order of Galliani, Lasinger & Schindler, *Massively parallel
multiview stereopsis by surface normal diffusion* (ICCV 2015) and the candidates of Xu & Tao, *Multi-scale geometric consistency
guided multi-view stereo* (CVPR 2019): four neighbours and, in four directions, the cheapest of a few farther ones. After random
perturbation a parabola through three costs gives the minimum along the depth and along the two slopes, with subpixel precision.

Pixels of one colour read only those of the other, and random numbers are a hash of pixel and sweep: results do not depend on threads.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from gsbake.kernels.declaration import kernel
from gsbake.mvs.ncc import FASTMATH, RADIUS, ncc_cost, patch_statistics

#: Minimum cosine between a plane's normal and the viewing ray.
MIN_COSINE = np.float32(0.12)
#: Costs are truncated here, so that one occluded view does not decide between planes.
MAX_COST = np.float32(1.0)
#: Minimum variance of a patch (grey levels squared): flat patches are not matched.
MIN_VARIANCE = np.float32(0.5)
#: Pixels with a lower cost skip propagation and perturbation; their planes are only refined.
CONVERGED_COST = np.float32(0.03)

#: Row and column steps to the four neighbours.
_DIRECTIONS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)], np.int64)


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def _random(state: Any) -> Any:
    """Next state of a hash (splitmix64) and a number in -1..1."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return state, np.float32(np.int64(z >> np.uint64(40))) * np.float32(2.0 / (1 << 24)) - np.float32(1)


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def _is_valid(m0: Any, m1: Any, m2: Any, x: Any, y: Any, low: Any, high: Any) -> Any:
    """Whether plane m crosses the ray within inverse depths low..high and faces the camera."""
    rho = m0 * x + m1 * y + m2
    if not (rho >= low and rho <= high):
        return False
    return rho * rho > MIN_COSINE * MIN_COSINE * (m0 * m0 + m1 * m1 + m2 * m2) * (x * x + y * y + np.float32(1))


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def _mean_cost(
    m0: Any, m1: Any, m2: Any, x: Any, y: Any, sx: Any, sy: Any, pattern: Any, weight: Any, moment: Any, views: Any,
    chosen_views: Any, best_views: int, bound: Any,
) -> Any:  # fmt: skip
    """Mean cost over `chosen_views` (one bit a view), or over the best `best_views` (at most 3) of all when none are chosen.

    The sum stops once the mean exceeds `bound`; the result is then some number above it.
    """
    total = np.float32(0)
    if chosen_views != 0:
        count = 0
        for j in range(views[0].shape[0]):
            count += (chosen_views >> j) & 1
        limit = bound * np.float32(count)
        for j in range(views[0].shape[0]):
            if (chosen_views >> j) & 1:
                c = ncc_cost(j, m0, m1, m2, x, y, sx, sy, pattern, weight, moment, views)
                total += min(c, MAX_COST)
                if total > limit:
                    break
        return total / np.float32(count)
    first, second, third = MAX_COST, MAX_COST, MAX_COST
    for j in range(views[0].shape[0]):
        c = ncc_cost(j, m0, m1, m2, x, y, sx, sy, pattern, weight, moment, views)
        if c < first:
            first, second, third = c, first, second
        elif c < second:
            second, third = c, second
        elif c < third:
            third = c
    if best_views >= 3:
        return (first + second + third) / np.float32(3)
    return (first + second) * np.float32(0.5) if best_views == 2 else first


@kernel(
    "f4[:, :, ::1], f4[:, ::1], u1[:, ::1], f4[:, ::1], u1[:, ::1], u1[:, ::1], f4[::1], UniTuple(f4[::1], 4), "
    "Tuple((f4[:, ::1], u4[::1], i8[::1], i8[:, ::1])), i8, b1, i8",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def evaluate_planes(
    planes: Any, cost: Any, chosen_views: Any, high: Any, grey: Any, inside: Any, intrinsics: Any, pattern: Any, views: Any,
    best_views: int, select_views: bool, checkerboard: int,
) -> None:  # fmt: skip
    """Cost of every pixel's plane; with `select_views` the `best_views` cheapest views go into `chosen_views` (h, w), one bit a view.

    `intrinsics` is fx, fy, cx, cy of the reference with the principal point less half a pixel; `high` (h, w) is 0 where nothing is
    matched. With `checkerboard` = 1 only pixels of the first colour are processed, here and in `refine_planes`.
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    sx, sy = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    count_views = views[0].shape[0]
    each = np.empty(count_views, np.float32)
    for v in range(high.shape[0]):
        y = (np.float32(v) - intrinsics[3]) * sy
        for u in range(v & 1 if checkerboard else 0, high.shape[1], 1 + checkerboard):
            chosen_views[v, u] = 0
            cost[v, u] = MAX_COST
            if not high[v, u] > 0:
                continue
            if patch_statistics(grey, inside, v, u, pattern, weight, moment) < MIN_VARIANCE:
                continue
            x = (np.float32(u) - intrinsics[2]) * sx
            m0, m1, m2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            for j in range(count_views):
                each[j] = ncc_cost(j, m0, m1, m2, x, y, sx, sy, pattern, weight, moment, views)
            total, chosen, count = np.float32(0), 0, 0
            for _ in range(best_views):
                cheapest = -1
                for j in range(count_views):
                    if (chosen >> j) & 1 == 0 and each[j] < np.float32(1.99) and (cheapest < 0 or each[j] < each[cheapest]):
                        cheapest = j
                if cheapest < 0:
                    break
                chosen |= 1 << cheapest
                total += min(each[cheapest], MAX_COST)
                count += 1
            if count > 0:
                cost[v, u] = total / np.float32(count)
                if select_views:
                    chosen_views[v, u] = chosen


@kernel(
    "i8, i8, f4[:, :, ::1], f4[:, ::1], u1[:, ::1], f4[:, ::1], f4[:, ::1], u1[:, ::1], u1[:, ::1], f4[::1], UniTuple(f4[::1], 4), "
    "Tuple((f4[:, ::1], u4[::1], i8[::1], i8[:, ::1])), i8, f4, f4, i8, i8",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def sweep(
    colour: int, seed: int, planes: Any, cost: Any, chosen_views: Any, low: Any, high: Any, grey: Any, inside: Any, intrinsics: Any,
    pattern: Any, views: Any, best_views: int,
    pixel: Any, perturbation: Any, trials: int, far: int,
) -> None:  # fmt: skip
    """Propagate better planes from pixels of the other colour, then try `trials` perturbations of up to `perturbation` pixels of disparity.

    `pixel` is the inverse depth that moves a match by one pixel; candidates lie up to 2 far + 1 pixels away (0: direct neighbours only).
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    height, width = high.shape
    sx, sy = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    tilt_x, tilt_y = intrinsics[0] / np.float32(RADIUS), intrinsics[1] / np.float32(RADIUS)
    for v in range(height):
        y = (np.float32(v) - intrinsics[3]) * sy
        for u in range((v + colour) & 1, width, 2):
            if not high[v, u] > 0:
                continue
            best = cost[v, u]
            if best < CONVERGED_COST or patch_statistics(grey, inside, v, u, pattern, weight, moment) < MIN_VARIANCE:
                continue
            x = (np.float32(u) - intrinsics[2]) * sx
            m0, m1, m2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            own_views = np.int64(chosen_views[v, u])
            for direction in range(_DIRECTIONS.shape[0]):
                dy, dx = _DIRECTIONS[direction, 0], _DIRECTIONS[direction, 1]
                for reach in range(2):
                    row, column = -1, -1
                    if reach == 0:
                        row, column = v + dy, u + dx
                        if row < 0 or column < 0 or row >= height or column >= width or not high[row, column] > 0:
                            continue
                    else:
                        for step in range(1, far + 1):
                            a, b = v + dy * (2 * step + 1), u + dx * (2 * step + 1)
                            if a < 0 or b < 0 or a >= height or b >= width:
                                break
                            if high[a, b] > 0 and (row < 0 or cost[a, b] < cost[row, column]):
                                row, column = a, b
                        if row < 0:
                            continue
                    n0, n1, n2 = planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]
                    if n0 == m0 and n1 == m1 and n2 == m2:
                        continue
                    if not _is_valid(n0, n1, n2, x, y, low[v, u], high[v, u]):
                        continue
                    c = _mean_cost(n0, n1, n2, x, y, sx, sy, pattern, weight, moment, views, own_views, best_views, best)
                    if c < best:
                        best, m0, m1, m2 = c, n0, n1, n2
            state = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(v * width + u) * np.uint64(0x2545F4914F6CDD1D)
            size = perturbation * pixel
            for trial in range(trials):
                state, r = _random(state)
                state, p = _random(state)
                state, q = _random(state)
                kind = trial % 3  # depth and slopes, depth alone, slopes alone
                if kind == 1:
                    p = q = np.float32(0)
                elif kind == 2:
                    r = np.float32(0)
                p *= size * tilt_x
                q *= size * tilt_y
                n0, n1, n2 = m0 + p, m1 + q, m2 + size * r - p * x - q * y
                if _is_valid(n0, n1, n2, x, y, low[v, u], high[v, u]):
                    c = _mean_cost(n0, n1, n2, x, y, sx, sy, pattern, weight, moment, views, own_views, best_views, best)
                    if c < best:
                        best, m0, m1, m2 = c, n0, n1, n2
                if kind == 2:
                    size *= np.float32(0.5)
            planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = m0, m1, m2
            cost[v, u] = best


@kernel(
    "f4[:, :, ::1], f4[:, ::1], u1[:, ::1], f4[:, ::1], f4[:, ::1], u1[:, ::1], u1[:, ::1], f4[::1], UniTuple(f4[::1], 4), "
    "Tuple((f4[:, ::1], u4[::1], i8[::1], i8[:, ::1])), i8, f4, f4, i8, f4, i8",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def refine_planes(
    planes: Any, cost: Any, chosen_views: Any, low: Any, high: Any, grey: Any, inside: Any, intrinsics: Any, pattern: Any, views: Any,
    best_views: int, pixel: Any, step: Any, iterations: int, max_cost: Any, checkerboard: int,
) -> None:  # fmt: skip
    """Move every plane to the minimum of parabolas through its cost and those `step` pixels of disparity away, along depth and slopes.

    Pixels with a cost of `max_cost` or more stay unchanged. The step halves each round.
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    sx, sy = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    tilt_x, tilt_y = intrinsics[0] / np.float32(RADIUS), intrinsics[1] / np.float32(RADIUS)
    unbounded = np.float32(9)
    for v in range(high.shape[0]):
        y = (np.float32(v) - intrinsics[3]) * sy
        for u in range(v & 1 if checkerboard else 0, high.shape[1], 1 + checkerboard):
            best = cost[v, u]
            if not (high[v, u] > 0 and best < max_cost):
                continue
            if patch_statistics(grey, inside, v, u, pattern, weight, moment) < MIN_VARIANCE:
                continue
            x = (np.float32(u) - intrinsics[2]) * sx
            m0, m1, m2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            own_views = np.int64(chosen_views[v, u])
            size = pixel * step
            for _ in range(iterations):
                for axis in range(3):
                    a0, a1, a2 = np.float32(0), np.float32(0), size
                    if axis == 1:
                        a0, a2 = size * tilt_x, -size * tilt_x * x
                    elif axis == 2:
                        a1, a2 = size * tilt_y, -size * tilt_y * y
                    before = _mean_cost(
                        m0 - a0, m1 - a1, m2 - a2, x, y, sx, sy, pattern, weight, moment, views, own_views, best_views, unbounded
                    )
                    after = _mean_cost(
                        m0 + a0, m1 + a1, m2 + a2, x, y, sx, sy, pattern, weight, moment, views, own_views, best_views, unbounded
                    )
                    curvature = before + after - np.float32(2) * best
                    if not curvature > np.float32(1e-6):
                        continue
                    offset = min(max(np.float32(0.5) * (before - after) / curvature, np.float32(-1.5)), np.float32(1.5))
                    n0, n1, n2 = m0 + offset * a0, m1 + offset * a1, m2 + offset * a2
                    if _is_valid(n0, n1, n2, x, y, low[v, u], high[v, u]):
                        c = _mean_cost(n0, n1, n2, x, y, sx, sy, pattern, weight, moment, views, own_views, best_views, best)
                        if c < best:
                            best, m0, m1, m2 = c, n0, n1, n2
                size *= np.float32(0.5)
            planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = m0, m1, m2
            cost[v, u] = best


@kernel("f4[:, :, ::1], f4[:, ::1], f4[:, ::1], f4[::1], f4", fastmath=FASTMATH, error_model="numpy", nogil=True)
def interpolate_planes(planes: Any, cost: Any, high: Any, intrinsics: Any, share: Any) -> None:
    """Set pixels of the second colour to the mean plane and cost of those neighbours that agree with the cheapest one.

    Two planes agree when their inverse depths at the pixel differ by less than `share` of the inverse depth.
    """
    height, width = high.shape
    for v in range(height):
        y = (np.float32(v) - intrinsics[3]) / intrinsics[1]
        for u in range((v + 1) & 1, width, 2):
            cost[v, u] = MAX_COST
            if not high[v, u] > 0:
                continue
            x = (np.float32(u) - intrinsics[2]) / intrinsics[0]
            best, rho = MAX_COST, np.float32(0)
            for direction in range(_DIRECTIONS.shape[0]):
                a, b = v + _DIRECTIONS[direction, 0], u + _DIRECTIONS[direction, 1]
                if a >= 0 and b >= 0 and a < height and b < width and high[a, b] > 0 and cost[a, b] < best:
                    best = cost[a, b]
                    rho = planes[a, b, 0] * x + planes[a, b, 1] * y + planes[a, b, 2]
            if not best < MAX_COST:
                continue
            count, total, m0, m1, m2 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for direction in range(_DIRECTIONS.shape[0]):
                a, b = v + _DIRECTIONS[direction, 0], u + _DIRECTIONS[direction, 1]
                if a >= 0 and b >= 0 and a < height and b < width and high[a, b] > 0 and cost[a, b] < MAX_COST:
                    gap = planes[a, b, 0] * x + planes[a, b, 1] * y + planes[a, b, 2] - rho
                    if abs(gap) < share * rho:
                        count += np.float32(1)
                        total += cost[a, b]
                        m0 += planes[a, b, 0]
                        m1 += planes[a, b, 1]
                        m2 += planes[a, b, 2]
            if count > 0:
                planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = m0 / count, m1 / count, m2 / count
                cost[v, u] = total / count
