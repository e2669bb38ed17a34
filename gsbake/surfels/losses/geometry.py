"""What the losses ask of the blended planes themselves, value and gradient in one pass over the rows (Numba).

Normal consistency (2DGS, Huang et al. 2024), cross-entropy of alpha against the mask, distortion, and alpha's part in the composited
picture. The normals of the depth come from central differences of back-projected pixels: each pixel has four gradients to give, to the
depths left, right, above and below; rows roll through rings of three, so that each row collects its own. The twins are in
`gsbake.surfels.losses.terms`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.surfels.losses.photometric import BYTE
from gsbake.surfels.raster.blocks import JIT
from gsbake.surfels.raster.lanes import LANES, broadcast, lane_column, lane_row, load, log, select, sqrt, store, sum_lanes

#: Rows of one piece of work; one more on either side is computed for it.
STRIP = 64
#: Alpha at or below which a pixel has no expected depth, and the range alpha is held to in the cross-entropy.
ALPHA_SURFACE, ENTROPY_MIN = np.float32(1e-3), np.float32(1e-6)
ENTROPY_MAX = np.float32(1 - 1e-6)
#: Squared length of the cross product below which the depth has no normal.
MIN_SQUARED_LENGTH = np.float32(1e-24)
RING = 3
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_U1, _U8 = np.uint64(1), np.uint64(LANES)
# planes behind the features, as in `gsbake.surfels.raster.kernel`
_DEPTH, _DISTORTION, _B1, _B2, _ALPHA, _MEDIAN = range(6)


@kernel("i8, i8, f4[::1], i8, i8, i8, u1[::1], b1, f4[::1], f4[::1], f4[:, ::1], f4[::1], f4[::1], f4[::1], f4[:, ::1]", **JIT)
def _strips(  # type: ignore[no-untyped-def]
    lo, hi, planes, channels, height, width, mask, masked, g_picture, background, rot, camera, weights, grad, sums
):
    blocks, u_width, size = np.uint64((width + LANES - 1) // LANES), np.uint64(width), height * width
    row = blocks * _U8 + np.uint64(2 * LANES)  # eight zeros on either side
    ring = np.uint64(RING) * row
    # rings of expected depth, alpha, mask and of the gradients for the depths around
    o_e = _U8
    o_a = o_e + ring
    o_m = o_a + ring
    o_left = o_m + ring
    o_right = o_left + ring
    o_up = o_right + ring
    o_down = o_up + ring
    # single rows: the world normal and then its gradient, gradients of picture (then of alpha) and depth, where differences and pixels are
    o_n = o_down + ring
    o_g = o_n + ring
    o_d = o_g + ring
    o_frame = o_d + row
    o_valid = o_frame + row
    s = np.zeros(o_valid + row, np.float32)
    for x in range(u_width):
        s[o_valid + x] = _ONE
        s[o_frame + x] = _ONE if 0 < x < u_width - _U1 else _ZERO
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    w_normal, w_entropy, w_distortion = weights[0], weights[1], weights[2]
    r00, r01, r02 = broadcast(rot[0, 0]), broadcast(rot[0, 1]), broadcast(rot[0, 2])
    r10, r11, r12 = broadcast(rot[1, 0]), broadcast(rot[1, 1]), broadcast(rot[1, 2])
    r20, r21, r22 = broadcast(rot[2, 0]), broadcast(rot[2, 1]), broadcast(rot[2, 2])
    zero, one = broadcast(_ZERO), broadcast(_ONE)
    ramp = (lane_column() + np.float32(4.0) * lane_row() + (_HALF - cx)) / fx
    step, pitch = np.float32(LANES) / fx, _ONE / fx
    p_depth, p_alpha = (channels + _DEPTH) * size, (channels + _ALPHA) * size
    for strip in range(lo, hi):
        y0, y1 = strip * STRIP, min(height, (strip + 1) * STRIP)
        for y in range(y0 - 3, y1 + 1):
            # the row below enters: its expected depth, alpha and mask
            entering = y + 1
            if 0 <= entering < height:
                slot = np.uint64(entering % RING) * row
                e, a, m = o_e + slot, o_a + slot, o_m + slot
                at_z, at_a, at_m = np.uint64(p_depth + entering * width), np.uint64(p_alpha + entering * width), np.uint64(entering * width)
                for x in range(u_width):
                    alpha = planes[at_a + x]
                    s[a + x] = alpha
                    s[e + x] = planes[at_z + x] / alpha if alpha > ALPHA_SURFACE else _ZERO
                    s[m + x] = np.float32(mask[at_m + x]) * BYTE if masked else (_ONE if alpha > _HALF else _ZERO)
            if y < y0 - 1:
                continue
            slot = np.uint64(y % RING) * row
            normal_sum, entropy_sum = zero, zero
            if 0 < y < height - 1:
                for j in range(3):
                    at, to = np.uint64((channels - 3 + j) * size + y * width), o_n + np.uint64(j) * row
                    for x in range(u_width):
                        s[to + x] = planes[at + x]
                above, below = o_e + np.uint64((y - 1) % RING) * row, o_e + np.uint64((y + 1) % RING) * row
                yt, ym, yb = (y - _HALF - cy) / fy, (y + _HALF - cy) / fy, (y + np.float32(1.5) - cy) / fy
                yt, ym, yb = np.float32(yt), np.float32(ym), np.float32(yb)
                for i in range(blocks):
                    at = i * _U8
                    xm = ramp + np.float32(i) * step
                    xl, xr = xm - pitch, xm + pitch
                    zl, zr = load(s, o_e + slot + at - _U1), load(s, o_e + slot + at + _U1)
                    zt, zb = load(s, above + at), load(s, below + at)
                    u0, u2 = zr * xr - zl * xl, zr - zl
                    u1 = u2 * ym
                    v1, v2 = zb * yb - zt * yt, zb - zt
                    v0 = v2 * xm
                    n0, n1, n2 = v1 * u2 - v2 * u1, v2 * u0 - v0 * u2, v0 * u1 - v1 * u0
                    square = n0 * n0 + n1 * n1 + n2 * n2
                    inside = select(load(s, o_m + slot + at) > _HALF, load(s, o_frame + at), zero)
                    found = square > MIN_SQUARED_LENGTH
                    inverse = select(found, one / sqrt(select(found, square, one)), zero)
                    n0, n1, n2 = n0 * inverse, n1 * inverse, n2 * inverse
                    # the blended normal in the camera's frame
                    w0, w1, w2 = load(s, o_n + at), load(s, o_n + row + at), load(s, o_n + row + row + at)
                    c0, c1, c2 = r00 * w0 + r01 * w1 + r02 * w2, r10 * w0 + r11 * w1 + r12 * w2, r20 * w0 + r21 * w1 + r22 * w2
                    dot = n0 * c0 + n1 * c1 + n2 * c2
                    normal_sum = normal_sum - inside * dot
                    weight = zero - w_normal * inside
                    store(s, o_n + at, weight * (r00 * n0 + r10 * n1 + r20 * n2))
                    store(s, o_n + row + at, weight * (r01 * n0 + r11 * n1 + r21 * n2))
                    store(s, o_n + row + row + at, weight * (r02 * n0 + r12 * n1 + r22 * n2))
                    # through the normalisation and the cross product v × u
                    weight = weight * inverse
                    g0, g1, g2 = weight * (c0 - dot * n0), weight * (c1 - dot * n1), weight * (c2 - dot * n2)
                    gv0, gv1, gv2 = u1 * g2 - u2 * g1, u2 * g0 - u0 * g2, u0 * g1 - u1 * g0
                    gu0, gu1, gu2 = g1 * v2 - g2 * v1, g2 * v0 - g0 * v2, g0 * v1 - g1 * v0
                    across, down = gu1 * ym + gu2, gv0 * xm + gv2
                    store(s, o_right + slot + at, gu0 * xr + across)
                    store(s, o_left + slot + at, zero - (gu0 * xl + across))
                    store(s, o_down + slot + at, gv1 * yb + down)
                    store(s, o_up + slot + at, zero - (gv1 * yt + down))
            else:
                for x in range(row):
                    for o in (o_right, o_left, o_down, o_up):
                        s[o + slot + x - _U8] = _ZERO
                for x in range(np.uint64(3) * row):
                    s[o_n + x - _U8] = _ZERO
            if y0 <= y < y1:
                sums[y, 0] = sum_lanes(normal_sum)
                for j in range(3):
                    at, to = o_n + np.uint64(j) * row, np.uint64((channels - 3 + j) * size + y * width)
                    for x in range(u_width):
                        grad[to + x] = s[at + x]
            done = y - 1  # all that reaches this row's depth is there
            if not y0 <= done < y1:
                continue
            slot = np.uint64(done % RING) * row
            above, below = np.uint64((done - 1) % RING) * row, np.uint64(y % RING) * row
            for c in range(3):
                at, to = np.uint64((c * height + done) * width), o_g + np.uint64(c) * row
                for x in range(u_width):
                    s[to + x] = g_picture[at + x]
            covered = zero
            for i in range(blocks):
                at = i * _U8
                alpha = load(s, o_a + slot + at)
                valid, cover = load(s, o_valid + at), load(s, o_m + slot + at)
                surface = alpha > ALPHA_SURFACE
                inverse = select(surface, one / select(surface, alpha, one), zero)
                g = load(s, o_right + slot + at - _U1) + load(s, o_left + slot + at + _U1)
                g = (g + load(s, o_down + above + at) + load(s, o_up + below + at)) * inverse
                inside = select(cover > _HALF, valid, zero)
                covered = covered + inside * alpha
                g_alpha = w_normal * inside - g * load(s, o_e + slot + at)
                for c in range(3):
                    g_alpha = g_alpha - background[c] * load(s, o_g + np.uint64(c) * row + at)
                held = select(alpha > ENTROPY_MIN, select(alpha < ENTROPY_MAX, alpha, broadcast(ENTROPY_MAX)), broadcast(ENTROPY_MIN))
                rest = one - held
                entropy_sum = entropy_sum - valid * (cover * log(held) + (one - cover) * log(rest))
                free = (alpha >= ENTROPY_MIN) & (alpha <= ENTROPY_MAX)
                g_alpha = g_alpha + w_entropy * select(free, (held - cover) / (held * rest), zero)
                store(s, o_d + at, g)
                store(s, o_g + at, g_alpha)
            sums[done, 0] += sum_lanes(covered)
            sums[done, 1] = sum_lanes(entropy_sum)
            first = np.uint64(channels * size + done * width)
            plane = np.uint64(size)
            distortion = _ZERO
            for x in range(u_width):
                grad[first + x] = s[o_d + x]
                distortion += planes[first + plane + x]
                grad[first + plane + x] = w_distortion
                grad[first + np.uint64(_B1) * plane + x] = _ZERO
                grad[first + np.uint64(_B2) * plane + x] = _ZERO
                grad[first + np.uint64(_ALPHA) * plane + x] = s[o_g + x]
                grad[first + np.uint64(_MEDIAN) * plane + x] = _ZERO
            sums[done, 2] = distortion


def geometry_losses(
    planes: Any, channels: int, height: int, width: int, mask: Any, masked: bool, g_picture: Any, background: Any, rot: Any, camera: Any,
    weights: tuple[float, float, float], grad: Any,
) -> tuple[float, float, float]:  # fmt: skip
    """Σ inside (alpha − n · n_depth), the summed cross-entropy and the summed distortion; gradients to `grad`.

    Flat contiguous arrays: `planes` and `grad` ((channels + 6) h w) float32 as `raster.kernel` lays them out, the last three features
    being the blended world normals; `mask` (h w) 8-bit (`masked` false: pixels with alpha above ½ are inside and the cross-entropy is
    meaningless); `g_picture` (3 h w) the gradient of the composited picture over `background` (3,). `rot` (3, 3) is world→camera, `camera`
    (fx, fy, cx, cy), both float32. `weights` multiply the gradients of the three sums. Written are the rows of normals, depth,
    distortion and alpha; those of the moments and the median become zero; the other features' are left alone.
    """
    sums = np.empty((height, 3), np.float32)
    factors = np.array(weights, np.float32)
    args = (planes, channels, height, width, mask, masked, g_picture, background, rot, camera, factors, grad, sums)
    run_chunks(lambda lo, hi: _strips(lo, hi, *args), -(-height // STRIP))
    normal, entropy, distortion = sums.sum(0, dtype=np.float64)
    return float(normal), float(entropy), float(distortion)
