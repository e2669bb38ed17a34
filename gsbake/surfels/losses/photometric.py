"""The colour loss of a composited picture, value and gradient in one pass: (1 − λ) L1 + λ (1 − SSIM) (Numba).

SSIM has the 11-tap Gaussian window of Wang et al. 2004. Rows roll through rings of eleven that stay in the cache: a row is composed,
blurred across, blurred down with its neighbours, turned into ∂SSIM/∂(E a, E(a² + b²), E ab), and these are blurred back the same way. The
twin is `gsbake.surfels.losses.terms.colour` on the composited picture.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.surfels.raster.blocks import JIT
from gsbake.surfels.raster.lanes import LANES, broadcast, load, select, store, sum_lanes

TAPS = 11
HALF = TAPS // 2
_x = np.arange(HALF + 1)
#: One side of the window, the middle first.
WINDOW = (np.exp(-(_x**2) / 4.5) / (2 * np.exp(-(_x**2) / 4.5).sum() - 1)).astype(np.float32)
C1, C2 = np.float32(1e-4), np.float32(9e-4)
#: Rows of one piece of work; ten more on either side are composed and blurred across for it.
STRIP = 128
BYTE = np.float32(1 / 255)
_ONE, _TWO, _ZERO = np.float32(1.0), np.float32(2.0), np.float32(0.0)
_U1, _U2, _U3, _U4, _U5, _U8, _U11 = (np.uint64(i) for i in (1, 2, 3, 4, 5, LANES, TAPS))


@njit(**JIT)
def _across(s, source, target, blocks, k):  # type: ignore[no-untyped-def]
    """Blur one row of the scratch `s`; eight zeros lie on either side of it."""
    k0, k1, k2, k3, k4, k5 = broadcast(k[0]), broadcast(k[1]), broadcast(k[2]), broadcast(k[3]), broadcast(k[4]), broadcast(k[5])
    for i in range(blocks):
        at = source + i * _U8
        near = k0 * load(s, at) + k1 * (load(s, at - _U1) + load(s, at + _U1)) + k2 * (load(s, at - _U2) + load(s, at + _U2))
        far = k3 * (load(s, at - _U3) + load(s, at + _U3)) + k4 * (load(s, at - _U4) + load(s, at + _U4))
        store(s, target + i * _U8, near + (far + k5 * (load(s, at - _U5) + load(s, at + _U5))))


@njit(**JIT)
def _down(s, rows, shift, k0, k1, k2, k3, k4, k5):  # type: ignore[no-untyped-def]
    """One block of the blur down; `rows` are the eleven rows' places, `shift` the way to the block."""
    near = k0 * load(s, rows[5] + shift) + k1 * (load(s, rows[4] + shift) + load(s, rows[6] + shift))
    near = near + k2 * (load(s, rows[3] + shift) + load(s, rows[7] + shift))
    far = k3 * (load(s, rows[2] + shift) + load(s, rows[8] + shift)) + k4 * (load(s, rows[1] + shift) + load(s, rows[9] + shift))
    return near + (far + k5 * (load(s, rows[0] + shift) + load(s, rows[10] + shift)))


@njit(**JIT)
def _window(rows, y, height, first, slot, nothing):  # type: ignore[no-untyped-def]
    """Places of rows y − 5 .. y + 5 in a ring of eleven slots from `first` on; rows outside the frame are `nothing`."""
    for k in range(TAPS):
        at = y + k - HALF
        rows[k] = first + np.uint64(at % TAPS) * slot if 0 <= at < height else nothing


@kernel("i8, i8, f4[::1], f4[::1], u1[::1], u1[::1], f4[::1], i8, i8, f4, f4[::1], f4[::1], f4[::1], f4[::1]", **JIT)
def _strips(  # type: ignore[no-untyped-def]
    lo, hi, picture, alpha, rgb, mask, background, height, width, share, grad, l1_rows, ssim_rows, k
):
    blocks, u_width = np.uint64((width + LANES - 1) // LANES), np.uint64(width)
    row = blocks * _U8 + np.uint64(2 * LANES)  # eight zeros on either side
    strips = (height + STRIP - 1) // STRIP
    # rings of a and b, of the four moments blurred across, of the three partials blurred across; four rows of zeros; single rows
    m_slot, p_slot = _U4 * row, _U3 * row
    r_a = _U8
    r_b = r_a + _U11 * row
    r_m = r_b + _U11 * row
    r_p = r_m + _U11 * m_slot
    nothing = r_p + _U11 * p_slot
    o_part = nothing + _U4 * row
    o_square, o_product, o_valid = o_part + p_slot, o_part + p_slot + row, o_part + p_slot + _U2 * row
    s = np.zeros(o_valid + row, np.float32)
    for x in range(u_width):
        s[o_valid + x] = _ONE
    rows = np.empty(TAPS, np.uint64)
    k0, k1, k2, k3, k4, k5 = broadcast(k[0]), broadcast(k[1]), broadcast(k[2]), broadcast(k[3]), broadcast(k[4]), broadcast(k[5])
    zero, one = broadcast(_ZERO), broadcast(_ONE)
    count = np.float32(3 * height * width)
    per_l1, per_ssim = (_ONE - share) / count, -share / count
    for task in range(lo, hi):
        c, strip = task // strips, task % strips
        y0, y1 = strip * STRIP, min(height, (strip + 1) * STRIP)
        back = background[c]
        for y in range(y0 - 2 * HALF, y1 + 2 * HALF):
            if 0 <= y < height:
                slot = np.uint64(y % TAPS)
                a, b, m = r_a + slot * row, r_b + slot * row, r_m + slot * m_slot
                flat, own = np.uint64(y * width), np.uint64((c * height + y) * width)
                for x in range(u_width):
                    cover = np.float32(mask[flat + x]) * BYTE
                    s[a + x] = picture[own + x] + back * (_ONE - alpha[flat + x])
                    s[b + x] = np.float32(rgb[own + x]) * BYTE * cover + back * (_ONE - cover)
                for i in range(blocks):
                    at = i * _U8
                    va, vb = load(s, a + at), load(s, b + at)
                    store(s, o_square + at, va * va + vb * vb)
                    store(s, o_product + at, va * vb)
                _across(s, a, m, blocks, k)
                _across(s, b, m + row, blocks, k)
                _across(s, o_square, m + _U2 * row, blocks, k)
                _across(s, o_product, m + _U3 * row, blocks, k)
            y_m = y - HALF  # the row whose eleven are complete
            if y0 - HALF <= y_m < y1 + HALF and 0 <= y_m < height:
                _window(rows, y_m, height, r_m, m_slot, nothing)
                similar = zero
                for i in range(blocks):
                    at = i * _U8
                    ma = _down(s, rows, at, k0, k1, k2, k3, k4, k5)
                    mb = _down(s, rows, at + row, k0, k1, k2, k3, k4, k5)
                    mq = _down(s, rows, at + _U2 * row, k0, k1, k2, k3, k4, k5)
                    mp = _down(s, rows, at + _U3 * row, k0, k1, k2, k3, k4, k5)
                    both, squares = ma * mb, ma * ma + mb * mb
                    # SSIM = (a1/b1) (a2/b2), luminance by structure; nothing beyond the frame's right margin
                    i1, i2 = one / (squares + C1), load(s, o_valid + at) / (mq - squares + C2)
                    p, q = (_TWO * both + C1) * i1, (_TWO * (mp - both) + C2) * i2
                    value = p * q
                    similar = similar + value
                    # in this form what cancels where the pictures agree is near zero before the large 1/b2 comes in
                    store(s, o_part + at, _TWO * (q * i1 * (mb - p * ma) - p * i2 * (mb - q * ma)))
                    store(s, o_part + row + at, zero - value * i2)
                    store(s, o_part + _U2 * row + at, _TWO * p * i2)
                if y0 <= y_m < y1:
                    ssim_rows[c * height + y_m] = sum_lanes(similar)
                to = r_p + np.uint64(y_m % TAPS) * p_slot
                for j in range(_U3):
                    _across(s, o_part + j * row, to + j * row, blocks, k)
            y_p = y - 2 * HALF  # the row whose eleven rows of partials are complete
            if y0 <= y_p < y1:
                _window(rows, y_p, height, r_p, p_slot, nothing)
                slot, off = np.uint64(y_p % TAPS), zero
                for i in range(blocks):
                    at = i * _U8
                    va, vb = load(s, r_a + slot * row + at), load(s, r_b + slot * row + at)
                    g = _down(s, rows, at, k0, k1, k2, k3, k4, k5)
                    g = g + _TWO * va * _down(s, rows, at + row, k0, k1, k2, k3, k4, k5)
                    g = g + vb * _down(s, rows, at + _U2 * row, k0, k1, k2, k3, k4, k5)
                    d = va - vb
                    up, down = d > zero, d < zero
                    off = off + select(up, d, zero - d)
                    store(s, o_square + at, per_ssim * g + select(up, per_l1, select(down, -per_l1, _ZERO)))
                l1_rows[c * height + y_p] = sum_lanes(off)
                own = np.uint64((c * height + y_p) * width)
                for x in range(u_width):
                    grad[own + x] = s[o_square + x]


def colour_loss(picture: Any, alpha: Any, rgb: Any, mask: Any, background: Any, height: int, width: int, share: float, grad: Any) -> float:
    """The loss of picture + background · (1 − alpha) against rgb · mask + background · (1 − mask); its gradient to the picture, `grad`.

    Flat contiguous arrays: `picture` and `grad` (3 h w) float32, `alpha` (h w) float32, `rgb` (3 h w) and `mask` (h w) 8-bit,
    `background` (3,) float32; `share` is λ.
    """
    l1, similar = np.empty(3 * height, np.float32), np.empty(3 * height, np.float32)
    args = (picture, alpha, rgb, mask, background, height, width, np.float32(share), grad, l1, similar, WINDOW)
    run_chunks(lambda lo, hi: _strips(lo, hi, *args), 3 * -(-height // STRIP))
    n = 3 * height * width
    return float((1 - share) * l1.sum(dtype=np.float64) / n + share * (1 - similar.sum(dtype=np.float64) / n))
