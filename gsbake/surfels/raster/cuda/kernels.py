"""The tile rasteriser in Triton: one program per 16x16 tile, forward and backward, after the formulas of `surfels.raster.kernel`.

Where the Numba kernel walks surfel by surfel over rows of pixels, a program here takes a chunk of surfels at once against all 256
pixels: the transmittance before each is a cumulative product along the chunk, and gradients are sums over the pixels. That keeps loads
wide and leaves one synchronisation per chunk and sum instead of one per surfel and sum.

Backward walks front to back like the Numba kernel, with what lies behind = total − prefix, and writes the gradient of each (tile, surfel)
pair to a slot of its own: no atomics, so two runs agree to the bit.
"""

from __future__ import annotations

import triton
import triton.language as tl

from gsbake.surfels.raster.cuda.binning import TILE
from gsbake.surfels.raster.kernel import ALPHA_MAX, ALPHA_MIN, NDC_SCALE, TRANSMITTANCE_MIN

#: Surfels per step and warps per program. Forward: sixteen is the least depth of Triton's matrix product. Backward keeps three times the
#: planes alive; at 8 numbers per thread and plane it just fits the 255 registers of a thread (ptxas for sm_90: 12 bytes spilled).
FORWARD = {"CHUNK": 16, "num_warps": 16}
BACKWARD = {"CHUNK": 4, "num_warps": 4}

_ALPHA_MIN = tl.constexpr(ALPHA_MIN)
_ALPHA_MAX = tl.constexpr(ALPHA_MAX)
_TRANSMITTANCE_MIN = tl.constexpr(TRANSMITTANCE_MIN)
_NDC_SCALE = tl.constexpr(NDC_SCALE)
_TILE = tl.constexpr(TILE)


@triton.jit
def _pixels(tiles_x, width, height):  # type: ignore[no-untyped-def]
    """Of this program's tile: pixel centres x and y (256,), flat index and whether it lies in the frame."""
    tile = tl.program_id(0)
    lane = tl.arange(0, _TILE * _TILE)
    px = tile % tiles_x * _TILE + lane % _TILE
    py = tile // tiles_x * _TILE + lane // _TILE
    return px + 0.5, py + 0.5, py * width + px, (px < width) & (py < height)


@triton.jit
def _intersect(geo, opacity, g, here, x, y, t_in, first):  # type: ignore[no-untyped-def]
    """Surfels g (n,) on pixels (256,) with transmittance t_in: results are (256, n), or (1, n) for the surfels' own coefficients.

    `here` masks the chunk's end; `first` is 1/z of the tile's first surfel. α is 0 where a surfel is skipped.
    """
    row = geo + g * 9
    ux, uy = tl.load(row + 2)[None, :], tl.load(row + 3)[None, :]
    vx, vy = tl.load(row + 4)[None, :], tl.load(row + 5)[None, :]
    wx, wy = tl.load(row + 6)[None, :], tl.load(row + 7)[None, :]
    zc = tl.load(row + 8)[None, :]
    dx = x[:, None] - tl.load(row)[None, :]
    dy = y[:, None] - tl.load(row + 1)[None, :]
    den = 1.0 + wx * dx + wy * dy
    ahead = den > 1e-4
    inv = 1.0 / tl.where(ahead, den, 1.0)
    u = (ux * dx + uy * dy) * inv
    v = (vx * dx + vy * dy) * inv
    r3 = tl.where(ahead, u * u + v * v, 1e8)
    r2 = 2.0 * (dx * dx + dy * dy)
    plane = r3 <= r2
    iz = tl.where(plane, den, 1.0) / zc
    z = tl.where(plane, zc * inv, zc)
    e = tl.exp(-0.5 * tl.where(plane, r3, r2))
    raw = tl.load(opacity + g)[None, :] * e
    alpha = tl.minimum(raw, _ALPHA_MAX)
    alpha = tl.where((alpha >= _ALPHA_MIN) & here[None, :], alpha, 0.0)
    after = t_in[:, None] * tl.cumprod(1.0 - alpha, axis=1)
    t = after / (1.0 - alpha)
    on = (alpha > 0.0) & (t >= _TRANSMITTANCE_MIN)
    e = tl.where(on & (raw < _ALPHA_MAX), e, 0.0)  # α's gradient reaches ρ and o only where it is neither clamped nor skipped
    alpha = tl.where(on, alpha, 0.0)
    return ux, uy, vx, vy, wx, wy, zc, dx, dy, inv, u, v, plane, iz, z, _NDC_SCALE * (first - iz), e, alpha, t, on, after


@triton.jit
def forward(  # type: ignore[no-untyped-def]
    starts, ids, geo, opacity, features, out, used, tiles_x, width, height, C: tl.constexpr, CP: tl.constexpr, CHUNK: tl.constexpr
):
    """Blend one tile's list into the planes `out` (C + 6, h, w), ordered as in `raster.kernel`; where it stopped goes to `used`
    (tiles,). CP is C rounded up to a power of two, at least 16."""
    x, y, pixel, inside = _pixels(tiles_x, width, height)
    begin, end = tl.load(starts + tl.program_id(0)), tl.load(starts + tl.program_id(0) + 1)
    lane, c = tl.arange(0, CHUNK), tl.arange(0, CP)
    t_in = tl.where(inside, 1.0, 0.0)
    blended = tl.zeros((_TILE * _TILE, CP), tl.float32)
    depth, b1, b2, median = t_in * 0.0, t_in * 0.0, t_in * 0.0, t_in * 0.0
    first = t_in * 0.0
    k = begin
    live = k < end
    if live:
        first += 1.0 / tl.load(geo + tl.load(ids + begin).to(tl.int64) * 9 + 8)
    while live:
        here = k + lane < end
        g = tl.load(ids + tl.minimum(k + lane, end - 1)).to(tl.int64)  # masked lanes repeat the last: their numbers must be finite
        _ux, _uy, _vx, _vy, _wx, _wy, _zc, _dx, _dy, _inv, _u, _v, _plane, _iz, z, m, _e, alpha, t, on, after = _intersect(
            geo, opacity, g, here, x, y, t_in, first[:, None]
        )
        w = alpha * t
        f = tl.load(features + g[:, None] * C + c[None, :], mask=c[None, :] < C, other=0.0)
        blended += tl.dot(w, f, input_precision="ieee")
        depth += tl.sum(w * z, 1)
        b1 += tl.sum(w * m, 1)
        b2 += tl.sum(w * m * m, 1)
        # the surfel at which T crosses one half: as many lie before it as leave T above
        at = tl.sum((after > 0.5).to(tl.int32), 1)
        crossing = tl.sum(tl.where(lane[None, :] == at[:, None], z, 0.0), 1)
        median = tl.where((t_in > 0.5) & (at < CHUNK), crossing, median)
        t_in = tl.min(tl.where(on, after, t_in[:, None]), 1)
        k += CHUNK
        live = (k < end) & (tl.max(t_in, 0) >= _TRANSMITTANCE_MIN)
    tl.store(used + tl.program_id(0), tl.minimum(k, end))
    size = width * height
    alpha_sum = 1.0 - t_in
    tl.store(out + c[None, :] * size + pixel[:, None], blended, mask=inside[:, None] & (c[None, :] < C))
    plane_c = out + C * size + pixel
    tl.store(plane_c, depth, mask=inside)
    # Σ_{i<j} w_i w_j (m_i − m_j)² of the totals
    tl.store(plane_c + size, alpha_sum * b2 - b1 * b1, mask=inside)
    tl.store(plane_c + 2 * size, b1, mask=inside)
    tl.store(plane_c + 3 * size, b2, mask=inside)
    tl.store(plane_c + 4 * size, alpha_sum, mask=inside)
    tl.store(plane_c + 5 * size, median, mask=inside)


@triton.jit
def backward(  # type: ignore[no-untyped-def]
    starts, ids, slots, geo, opacity, features, out, used, grad, result, tiles_x, width, height, C: tl.constexpr, CHUNK: tl.constexpr
):
    """From the planes' gradients `grad` (C + 3, h, w: features, depth, distortion, alpha) to one row of `result` (pairs, 11 + C) per pair:
    9 coefficients, opacity, Σ w, features."""
    x, y, pixel, inside = _pixels(tiles_x, width, height)
    begin, end = tl.load(starts + tl.program_id(0)), tl.load(used + tl.program_id(0))
    lane = tl.arange(0, CHUNK)
    size = width * height
    t_in = tl.where(inside, 1.0, 0.0)
    rest = t_in * 0.0
    for c in range(C):
        at = c * size + pixel
        rest += tl.load(grad + at, mask=inside, other=0.0) * tl.load(out + at, mask=inside, other=0.0)
    gz = tl.load(grad + C * size + pixel, mask=inside, other=0.0)
    gd = tl.load(grad + (C + 1) * size + pixel, mask=inside, other=0.0)
    ga = tl.load(grad + (C + 2) * size + pixel, mask=inside, other=0.0)
    plane_c = out + C * size + pixel
    b1 = tl.load(plane_c + 2 * size, mask=inside, other=0.0)
    b2 = tl.load(plane_c + 3 * size, mask=inside, other=0.0)
    total = tl.load(plane_c + 4 * size, mask=inside, other=0.0)
    rest += gz * tl.load(plane_c, mask=inside, other=0.0) + ga * total
    rest += 2.0 * gd * tl.load(plane_c + size, mask=inside, other=0.0)  # Σ w ∂D/∂w = 2 D
    first = t_in * 0.0
    k = begin
    if begin < end:
        first += 1.0 / tl.load(geo + tl.load(ids + begin).to(tl.int64) * 9 + 8)
    while k < end:
        here = k + lane < end
        g = tl.load(ids + tl.minimum(k + lane, end - 1)).to(tl.int64)  # masked lanes repeat the last: their numbers must be finite
        ux, uy, vx, vy, wx, wy, zc, dx, dy, inv, u, v, plane, iz, z, m, e, alpha, t, on, after = _intersect(
            geo, opacity, g, here, x, y, t_in, first[:, None]
        )
        w = alpha * t
        gw = ga[:, None] + gz[:, None] * z + gd[:, None] * (m * m * total[:, None] + b2[:, None] - 2.0 * m * b1[:, None])
        row = result + tl.load(slots + k + lane, mask=here, other=0) * (11 + C)
        for c in range(C):
            gc = tl.load(grad + c * size + pixel, mask=inside, other=0.0)[:, None]
            gw += gc * tl.load(features + g * C + c)[None, :]
            tl.store(row + 11 + c, tl.sum(w * gc, 0), mask=here)
        behind = rest[:, None] - tl.cumsum(w * gw, axis=1)
        g_alpha = t * gw - behind / (1.0 - alpha)
        rest -= tl.sum(w * gw, 1)
        t_in = tl.min(tl.where(on, after, t_in[:, None]), 1)
        tl.store(row + 9, tl.sum(g_alpha * e, 0), mask=here)
        tl.store(row + 10, tl.sum(w, 0), mask=here)
        flat = tl.where(plane, 1.0, 0.0)
        g_rho = -0.5 * g_alpha * tl.load(opacity + g)[None, :] * e
        g_low = 4.0 * g_rho * (1.0 - flat)
        gu, gv = 2.0 * g_rho * flat * u * inv, 2.0 * g_rho * flat * v * inv  # of the numerators of u and v
        g_m = 2.0 * w * gd[:, None] * (m * total[:, None] - b1[:, None])
        g_z = w * gz[:, None]
        tl.store(row + 8, tl.sum((g_z * z + g_m * _NDC_SCALE * iz) / zc, 0), mask=here)
        g_den = -(gu * u + gv * v) - flat * (inv * g_z * z + g_m * _NDC_SCALE / zc)
        tl.store(row, -tl.sum(gu * ux + gv * vx + g_den * wx + g_low * dx, 0), mask=here)
        tl.store(row + 1, -tl.sum(gu * uy + gv * vy + g_den * wy + g_low * dy, 0), mask=here)
        tl.store(row + 2, tl.sum(gu * dx, 0), mask=here)
        tl.store(row + 3, tl.sum(gu * dy, 0), mask=here)
        tl.store(row + 4, tl.sum(gv * dx, 0), mask=here)
        tl.store(row + 5, tl.sum(gv * dy, 0), mask=here)
        tl.store(row + 6, tl.sum(g_den * dx, 0), mask=here)
        tl.store(row + 7, tl.sum(g_den * dy, 0), mask=here)
        k += CHUNK
