"""Edge-aware smoothness of blended planes, value and gradient in one pass over the rows (Numba); its twin is `terms.smoothness_loss`.

Each pair of neighbours inside the mask has a weight exp(−10 |∇grey|); a pixel's gradient is what its four pairs give it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from gsbake.kernels.threads import run_chunks
from gsbake.surfels.losses.photometric import BYTE
from gsbake.surfels.raster.blocks import JIT
from gsbake.surfels.raster.lanes import EXP2_COEFFICIENTS, LANES, broadcast, exp2, load, select, store, sum_lanes

STRIP = 64
_ZERO = np.float32(0.0)
_U1, _U8 = np.uint64(1), np.uint64(LANES)
#: 2^(this · |∇grey|) is exp(−10 |∇grey|).
EDGE = np.float32(-10 / np.log(2))
_CONSTANTS = np.array(EXP2_COEFFICIENTS, np.float32)


@njit(**JIT)
def _edges(s, a, b, inside_a, inside_b, to, blocks, factor, p):  # type: ignore[no-untyped-def]
    """Weights of the pairs of two rows (or of a row and itself, one further)."""
    one, p1, p2, p3, p4, p5 = broadcast(p[0]), broadcast(p[1]), broadcast(p[2]), broadcast(p[3]), broadcast(p[4]), broadcast(p[5])
    zero = broadcast(_ZERO)
    for i in range(blocks):
        at = i * _U8
        d = load(s, b + at) - load(s, a + at)
        edge = exp2(EDGE * select(d > zero, d, zero - d), one, p1, p2, p3, p4, p5)
        store(s, to + at, factor * edge * load(s, inside_a + at) * load(s, inside_b + at))


@njit(**JIT)
def _strips(lo, hi, planes, count, height, width, rgb, inside, across, down, grad, sums, constants):  # type: ignore[no-untyped-def]
    blocks, u_width = np.uint64((width + LANES - 1) // LANES), np.uint64(width)
    size, u_size = height * width, np.uint64(height * width)
    row = blocks * _U8 + np.uint64(2 * LANES)
    # grey and inside of three rows (above, this, below), weights of the pairs above, to the right, below; one row each of work
    o_grey, o_in = _U8, _U8 + np.uint64(3) * row
    o_above = o_in + np.uint64(3) * row
    o_right = o_above + row
    o_below = o_right + row
    o_step = o_below + row
    o_g = o_step + row
    o_p = o_g + row
    s = np.zeros(o_p + np.uint64(3) * row, np.float32)
    zero = broadcast(_ZERO)
    third = BYTE / np.float32(3.0)
    for strip in range(lo, hi):
        y0, y1 = strip * STRIP, min(height, (strip + 1) * STRIP)
        for y in range(y0 - 2, y1):
            new = y + 1
            slot = np.uint64(new % 3) * row
            for x in range(u_width):
                s[o_in + slot + x] = _ZERO
            if 0 <= new < height:
                at = np.uint64(new * width)
                for x in range(u_width):
                    grey = np.float32(rgb[at + x]) + np.float32(rgb[at + u_size + x]) + np.float32(rgb[at + u_size + u_size + x])
                    s[o_grey + slot + x] = grey * third
                    s[o_in + slot + x] = inside[at + x]
            if y < y0 - 1:
                continue
            own = np.uint64(y % 3) * row
            _edges(s, o_grey + own, o_grey + slot, o_in + own, o_in + slot, o_below, blocks, down, constants)
            if y >= y0:
                _edges(s, o_grey + own, o_grey + own + _U1, o_in + own, o_in + own + _U1, o_right, blocks, across, constants)
                value = zero
                for c in range(count):
                    for k in range(3):
                        at = np.uint64(c * size + min(max(y - 1 + k, 0), height - 1) * width)
                        for x in range(u_width):
                            s[o_p + np.uint64(k) * row + x] = planes[at + x]
                    for i in range(blocks):
                        at = o_p + row + i * _U8
                        d = load(s, at + _U1) - load(s, at)
                        w = load(s, o_right + i * _U8)
                        value = value + w * select(d > zero, d, zero - d)
                        store(s, o_step + i * _U8, select(d > zero, w, select(d < zero, zero - w, zero)))
                    for i in range(blocks):
                        at = i * _U8
                        p = load(s, o_p + row + at)
                        above, below = p - load(s, o_p + at), load(s, o_p + row + row + at) - p
                        w = load(s, o_below + at)
                        value = value + w * select(below > zero, below, zero - below)
                        g = load(s, o_step + at - _U1) - load(s, o_step + at)
                        g = g - select(below > zero, w, select(below < zero, zero - w, zero))
                        w = load(s, o_above + at)
                        store(s, o_g + at, g + select(above > zero, w, select(above < zero, zero - w, zero)))
                    at = np.uint64(c * size + y * width)
                    for x in range(u_width):
                        grad[at + x] = s[o_g + x]
                sums[y] = sum_lanes(value)
            for x in range(u_width):
                s[o_above + x] = s[o_below + x]


def smoothness_loss(planes: Any, count: int, height: int, width: int, rgb: Any, inside: Any, weight: float, grad: Any) -> float:
    """The weighted loss of the first `count` planes; its gradient to those rows of `grad`.

    Flat contiguous arrays: `planes` and `grad` (at least count h w) float32, `rgb` (3 h w) 8-bit, `inside` (h, w) bool.
    """
    pairs = [max(1, int(np.count_nonzero(a & b))) for a, b in ((inside[:, 1:], inside[:, :-1]), (inside[1:], inside[:-1]))]
    across, down = (np.float32(weight / (count * n)) for n in pairs)
    sums = np.empty(height, np.float32)
    args = (planes, count, height, width, rgb, inside.reshape(-1), across, down, grad, sums, _CONSTANTS)
    run_chunks(lambda lo, hi: _strips(lo, hi, *args), -(-height // STRIP))
    return float(sums.sum(dtype=np.float64))
