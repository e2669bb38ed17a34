"""PatchMatch on planes: views are chosen per pixel, good planes spread over a checkerboard, and each is refined.

Bleyer, Rhemann & Rother, *PatchMatch Stereo* (BMVC 2011), with the red-black order of Galliani, Lasinger & Schindler, *Massively parallel
multiview stereopsis by surface normal diffusion* (ICCV 2015) and the candidates of Xu & Tao, *Multi-scale geometric consistency
guided multi-view stereo* (CVPR 2019): four neighbours and, in four directions, the cheapest of a few farther ones. After random steps a
parabola through three costs finds the minimum along the depth and along the two slopes: there lies the precision below a pixel.

Pixels of one colour read only those of the other, and random numbers are a hash of place and sweep.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from gsbake.mvs.ncc import FAST, RADIUS, describe, match

#: A plane that turns farther from the ray than this cosine is not tried.
LEAST_COSINE = np.float32(0.12)
#: Costs are cut here, so that one occluded view does not decide between planes.
WORST = np.float32(1.0)
#: Patches with less variance (grey levels squared) have nothing to match.
FLAT = np.float32(0.5)
#: Costs from which on a better plane is not searched for, only refined.
EASY = np.float32(0.03)
#: Most views that are compared at a pixel.
KEEP = 8

_WAYS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)], np.int64)


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _draw(state: Any) -> Any:
    """Next state of a hash (splitmix64) and a number in -1..1."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return state, np.float32(np.int64(z >> np.uint64(40))) * np.float32(2.0 / (1 << 24)) - np.float32(1)


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _allowed(m0: Any, m1: Any, m2: Any, x: Any, y: Any, low: Any, high: Any) -> Any:
    """Whether plane m crosses the ray within inverse depths low..high and faces the camera."""
    rho = m0 * x + m1 * y + m2
    if not (rho >= low and rho <= high):
        return False
    return rho * rho > LEAST_COSINE * LEAST_COSINE * (m0 * m0 + m1 * m1 + m2 * m2) * (x * x + y * y + np.float32(1))


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _mean_cost(
    m0: Any, m1: Any, m2: Any, x: Any, y: Any, sx: Any, sy: Any, pattern: Any, weight: Any, moment: Any, views: Any,
    bits: Any, best_of: int, bound: Any,
) -> Any:  # fmt: skip
    """Mean cost over the views in `bits`, or over the best `best_of` (at most 3) of all when there are none.

    Once the mean must exceed `bound` the sum is left unfinished: any number above it.
    """
    total = np.float32(0)
    if bits != 0:
        count = 0
        for j in range(views[0].shape[0]):
            count += (bits >> j) & 1
        limit = bound * np.float32(count)
        for j in range(views[0].shape[0]):
            if (bits >> j) & 1:
                c = match(j, m0, m1, m2, x, y, sx, sy, pattern, weight, moment, views)
                total += min(c, WORST)
                if total > limit:
                    break
        return total / np.float32(count)
    first, second, third = WORST, WORST, WORST
    for j in range(views[0].shape[0]):
        c = match(j, m0, m1, m2, x, y, sx, sy, pattern, weight, moment, views)
        if c < first:
            first, second, third = c, first, second
        elif c < second:
            second, third = c, second
        elif c < third:
            third = c
    if best_of >= 3:
        return (first + second + third) / np.float32(3)
    return (first + second) * np.float32(0.5) if best_of == 2 else first


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def settle(
    planes: Any, cost: Any, bits: Any, high: Any, grey: Any, inside: Any, lens: Any, pattern: Any, views: Any,
    best_of: int, choose: bool, thin: int,
) -> None:  # fmt: skip
    """Cost of every pixel's plane; with `choose` the `best_of` views that fit it best are noted in `bits` (h, w), one bit a view.

    `lens` is fx, fy, cx, cy of the reference with the principal point less half a pixel; `high` (h, w) is 0 where nothing is to
    be matched. With `thin` = 1 only pixels of the first colour are looked at, here and in `polish`.
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    sx, sy = np.float32(1) / lens[0], np.float32(1) / lens[1]
    count_views = views[0].shape[0]
    each = np.empty(count_views, np.float32)
    for v in range(high.shape[0]):
        y = (np.float32(v) - lens[3]) * sy
        for u in range(v & 1 if thin else 0, high.shape[1], 1 + thin):
            bits[v, u] = 0
            cost[v, u] = WORST
            if not high[v, u] > 0:
                continue
            if describe(grey, inside, v, u, pattern, weight, moment) < FLAT:
                continue
            x = (np.float32(u) - lens[2]) * sx
            m0, m1, m2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            for j in range(count_views):
                each[j] = match(j, m0, m1, m2, x, y, sx, sy, pattern, weight, moment, views)
            total, chosen, count = np.float32(0), 0, 0
            for _ in range(best_of):
                least = -1
                for j in range(count_views):
                    if (chosen >> j) & 1 == 0 and each[j] < np.float32(1.99) and (least < 0 or each[j] < each[least]):
                        least = j
                if least < 0:
                    break
                chosen |= 1 << least
                total += min(each[least], WORST)
                count += 1
            if count > 0:
                cost[v, u] = total / np.float32(count)
                if choose:
                    bits[v, u] = chosen


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def sweep(
    colour: int, seed: int, planes: Any, cost: Any, bits: Any, low: Any, high: Any, grey: Any, inside: Any, lens: Any,
    pattern: Any, views: Any, best_of: int,
    pixel: Any, spread: Any, tries: int, far: int,
) -> None:  # fmt: skip
    """Take over better planes from pixels of the other colour, then try `tries` random changes of up to `spread` pixels of disparity.

    `pixel` is the inverse depth that moves a match by one pixel; candidates are looked for up to 2 far + 1 pixels away (0: the next ones).
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    height, width = high.shape
    sx, sy = np.float32(1) / lens[0], np.float32(1) / lens[1]
    tilt_x, tilt_y = lens[0] / np.float32(RADIUS), lens[1] / np.float32(RADIUS)
    for v in range(height):
        y = (np.float32(v) - lens[3]) * sy
        for u in range((v + colour) & 1, width, 2):
            if not high[v, u] > 0:
                continue
            best = cost[v, u]
            if best < EASY or describe(grey, inside, v, u, pattern, weight, moment) < FLAT:
                continue
            x = (np.float32(u) - lens[2]) * sx
            m0, m1, m2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            mine = np.int64(bits[v, u])
            for way in range(_WAYS.shape[0]):
                dy, dx = _WAYS[way, 0], _WAYS[way, 1]
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
                    if not _allowed(n0, n1, n2, x, y, low[v, u], high[v, u]):
                        continue
                    c = _mean_cost(n0, n1, n2, x, y, sx, sy, pattern, weight, moment, views, mine, best_of, best)
                    if c < best:
                        best, m0, m1, m2 = c, n0, n1, n2
            state = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(v * width + u) * np.uint64(0x2545F4914F6CDD1D)
            size = spread * pixel
            for trial in range(tries):
                state, r = _draw(state)
                state, p = _draw(state)
                state, q = _draw(state)
                kind = trial % 3  # depth and slopes, depth alone, slopes alone
                if kind == 1:
                    p = q = np.float32(0)
                elif kind == 2:
                    r = np.float32(0)
                p *= size * tilt_x
                q *= size * tilt_y
                n0, n1, n2 = m0 + p, m1 + q, m2 + size * r - p * x - q * y
                if _allowed(n0, n1, n2, x, y, low[v, u], high[v, u]):
                    c = _mean_cost(n0, n1, n2, x, y, sx, sy, pattern, weight, moment, views, mine, best_of, best)
                    if c < best:
                        best, m0, m1, m2 = c, n0, n1, n2
                if kind == 2:
                    size *= np.float32(0.5)
            planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = m0, m1, m2
            cost[v, u] = best


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def polish(
    planes: Any, cost: Any, bits: Any, low: Any, high: Any, grey: Any, inside: Any, lens: Any, pattern: Any, views: Any,
    best_of: int, pixel: Any, step: Any, rounds: int, worst: Any, thin: int,
) -> None:  # fmt: skip
    """Move every plane to the minimum of parabolas through its cost and those `step` pixels of disparity away, along depth and slopes.

    Pixels dearer than `worst` are left as they are. The step halves each round.
    """
    weight = np.empty(pattern[0].shape[0], np.float32)
    moment = np.empty(pattern[0].shape[0], np.float32)
    sx, sy = np.float32(1) / lens[0], np.float32(1) / lens[1]
    tilt_x, tilt_y = lens[0] / np.float32(RADIUS), lens[1] / np.float32(RADIUS)
    endless = np.float32(9)
    for v in range(high.shape[0]):
        y = (np.float32(v) - lens[3]) * sy
        for u in range(v & 1 if thin else 0, high.shape[1], 1 + thin):
            best = cost[v, u]
            if not (high[v, u] > 0 and best < worst):
                continue
            if describe(grey, inside, v, u, pattern, weight, moment) < FLAT:
                continue
            x = (np.float32(u) - lens[2]) * sx
            m0, m1, m2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            mine = np.int64(bits[v, u])
            size = pixel * step
            for _ in range(rounds):
                for axis in range(3):
                    a0, a1, a2 = np.float32(0), np.float32(0), size
                    if axis == 1:
                        a0, a2 = size * tilt_x, -size * tilt_x * x
                    elif axis == 2:
                        a1, a2 = size * tilt_y, -size * tilt_y * y
                    before = _mean_cost(m0 - a0, m1 - a1, m2 - a2, x, y, sx, sy, pattern, weight, moment, views, mine, best_of, endless)
                    after = _mean_cost(m0 + a0, m1 + a1, m2 + a2, x, y, sx, sy, pattern, weight, moment, views, mine, best_of, endless)
                    bend = before + after - np.float32(2) * best
                    if not bend > np.float32(1e-6):
                        continue
                    way = min(max(np.float32(0.5) * (before - after) / bend, np.float32(-1.5)), np.float32(1.5))
                    n0, n1, n2 = m0 + way * a0, m1 + way * a1, m2 + way * a2
                    if _allowed(n0, n1, n2, x, y, low[v, u], high[v, u]):
                        c = _mean_cost(n0, n1, n2, x, y, sx, sy, pattern, weight, moment, views, mine, best_of, best)
                        if c < best:
                            best, m0, m1, m2 = c, n0, n1, n2
                size *= np.float32(0.5)
            planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = m0, m1, m2
            cost[v, u] = best


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def fill(planes: Any, cost: Any, high: Any, lens: Any, share: Any) -> None:
    """Give the pixels of the second colour the mean plane and cost of those neighbours that agree with the cheapest of them.

    Two planes agree when their inverse depths at the pixel differ by less than `share` of them.
    """
    height, width = high.shape
    for v in range(height):
        y = (np.float32(v) - lens[3]) / lens[1]
        for u in range((v + 1) & 1, width, 2):
            cost[v, u] = WORST
            if not high[v, u] > 0:
                continue
            x = (np.float32(u) - lens[2]) / lens[0]
            best, rho = WORST, np.float32(0)
            for way in range(_WAYS.shape[0]):
                a, b = v + _WAYS[way, 0], u + _WAYS[way, 1]
                if a >= 0 and b >= 0 and a < height and b < width and high[a, b] > 0 and cost[a, b] < best:
                    best = cost[a, b]
                    rho = planes[a, b, 0] * x + planes[a, b, 1] * y + planes[a, b, 2]
            if not best < WORST:
                continue
            count, total, m0, m1, m2 = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for way in range(_WAYS.shape[0]):
                a, b = v + _WAYS[way, 0], u + _WAYS[way, 1]
                if a >= 0 and b >= 0 and a < height and b < width and high[a, b] > 0 and cost[a, b] < WORST:
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
