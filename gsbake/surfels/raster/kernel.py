"""Tile rasteriser in Numba, forward and backward, after 2DGS (Huang et al., SIGGRAPH 2024).

Tiles have 16x16 pixels; a block of 4x2 pixels is one SIMD vector.

A projected surfel is nine numbers relative to its screen centre (xc, yc): with dx = x − xc, dy = y − yc and den = 1 + wx dx + wy dy, the
ray–plane intersection is u = (ux dx + uy dy)/den, v = (vx dx + vy dy)/den, its depth z = zc/den. With the low-pass filter of 2DGS,
ρ = min(u² + v², 2 (dx² + dy²)) and α = min(.99, o e^{−ρ/2}); α below 1/255 is skipped; a pixel ends once its transmittance T is below 1e-4.

Backward runs front to back: what a surfel occludes is the pixel's total minus the prefix sum, so nothing is stored per pixel and surfel.
Each (tile, surfel) pair writes its gradient to a slot of its own and slots are summed per surfel afterwards: no atomics, and the result
does not depend on the number of threads.

Per-pixel arithmetic uses `lanes`. Fast math excludes "nnan": a NaN would pass every guard and index out of bounds.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numba import njit

from gsbake.kernels.declaration import also_built_by, kernel
from gsbake.surfels.raster.blocks import BLOCKS_ACROSS, BLOCKS_DOWN, JIT, TILE, pack, unpack
from gsbake.surfels.raster.lanes import (
    BLOCK_X,
    BLOCK_Y,
    EXP2_COEFFICIENTS,
    LANES,
    any_lane,
    broadcast,
    exp2,
    lane_column,
    lane_row,
    load,
    prefetch,
    select,
    store,
    sum_lanes,
)

#: Planes after the features: depth, distortion, first and second moment of the NDC depth, alpha, median depth.
AUX_PLANES = 6
#: Auxiliary planes that carry a gradient: depth, distortion, alpha.
AUX_GRADIENTS = 3
#: Position of the feature gradients in a gradient slot, after those of 9 coefficients and opacity and the accumulated weight.
FEATURE_OFFSET = 11
#: Near and far plane (unit frame) of the NDC depth m = −NDC_SCALE / z + constant, on which distortion is measured (2DGS).
NEAR, FAR = 0.2, 100.0
NDC_SCALE = FAR * NEAR / (FAR - NEAR)
_NDC_SCALE = np.float32(NDC_SCALE)
#: Transmittance at which a pixel ends; also the t_min denominator `den` of an intersection in front of the camera.
TRANSMITTANCE_MIN = 1e-4
#: α below which a surfel is skipped, and the upper bound of α.
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
#: u and v are scaled by √(½ log₂ e), so that e^{−ρ/2} = 2^{−(u² + v²)}; the low-pass term 2 d² becomes log₂ e d².
EXP2_SCALE, LOW_PASS_SCALE = np.float32(math.sqrt(0.5 / math.log(2.0))), np.float32(1.0 / math.log(2.0))
#: Passed to the kernels as an array: LLVM reloads constants that it knows, address included, in every iteration of the inner loop.
CONSTANTS = np.array([*EXP2_COEFFICIENTS, ALPHA_MAX, TRANSMITTANCE_MIN, LOW_PASS_SCALE, math.log(2.0)], np.float32)


@lru_cache(maxsize=16)
def forward_kernel(channels: int) -> Any:
    """Forward kernel for one number of features: `f(order, lo, hi, starts, ids, geo, box, opacity, features, width, height, tiles_x,
    out, ends)`.

    Blends the tiles `order[lo:hi]` into the planes `out` (channels + 6, h, w) and stores in `ends` (tiles,) the list position at which each
    tile ended. The other arrays are those of `binning.Bins` and `projection.Project`.
    """
    c_n = np.uint64(channels)
    block_size = np.uint64((AUX_PLANES + channels) * LANES)
    total_size = BLOCKS_ACROSS * BLOCKS_DOWN * int(block_size)
    n8, n16, q_size = np.uint64(LANES), np.uint64(2 * LANES), np.uint64(3 * LANES)
    # offsets in a block: T, depth, distortion, first and second moment, median depth, features
    o_t, o_z, o_d, o_b1, o_b2, o_m, o_f = (np.uint64(i * LANES) for i in range(7))
    zero, half, one, two = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)

    @kernel(
        "i8[::1], i8, i8, i8[::1], i4[::1], f4[:, ::1], i4[:, ::1], f4[::1], f4[:, ::1], i8, i8, i8, f4[:, :, ::1], i8[::1], f4[::1]",
        **JIT,
    )
    def forward(order, lo, hi, starts, ids, geo, box, opacity, features, width, height, tiles_x, out, ends, constants):  # type: ignore[no-untyped-def]
        s = np.empty(total_size, np.float32)
        ones, p1, p2 = broadcast(constants[0]), broadcast(constants[1]), broadcast(constants[2])
        p3, p4, p5 = broadcast(constants[3]), broadcast(constants[4]), broadcast(constants[5])
        alpha_max, t_min, low_pass = broadcast(constants[6]), broadcast(constants[7]), broadcast(constants[8])
        image, u_w, size = out.reshape(out.size), np.uint64(width), np.uint64(width * height)
        step = np.float32(BLOCK_X)
        active = np.empty(BLOCKS_ACROSS * BLOCKS_DOWN, np.bool_)
        hits = np.empty(BLOCKS_ACROSS * BLOCKS_DOWN + 1, np.uint64)
        q = np.empty((BLOCKS_ACROSS * BLOCKS_DOWN + 1) * int(q_size), np.float32)
        for i in range(lo, hi):
            tile = order[i]
            ty = tile // tiles_x
            tx = tile - ty * tiles_x
            px, py = tx * TILE, ty * TILE
            n_cols, n_rows = min(TILE, width - px), min(TILE, height - py)
            origin, u_cols, u_rows = np.uint64(py * width + px), np.uint64(n_cols), np.uint64(n_rows)
            s[:] = zero
            for y in range(n_rows):  # pixels beyond the frame keep T = 0
                for x in range(n_cols):
                    b = (y // BLOCK_Y) * BLOCKS_ACROSS + x // BLOCK_X
                    s[np.uint64(b) * block_size + o_t + np.uint64((y % BLOCK_Y) * BLOCK_X + x % BLOCK_X)] = one
            n_active = 0
            for b in range(BLOCKS_ACROSS * BLOCKS_DOWN):
                active[b] = ((b // BLOCKS_ACROSS) * BLOCK_Y < n_rows) & ((b % BLOCKS_ACROSS) * BLOCK_X < n_cols)
                n_active += active[b]
            begin, end = starts[tile], starts[tile + 1]
            k = begin
            iz0 = zero
            if end > begin:
                iz0 = _NDC_SCALE / geo[ids[begin], 8]
            while k < end and n_active > 0:
                k_ahead = min(k + 3, end - 1)
                g_ahead = np.uint64(ids[k_ahead])
                prefetch(geo, g_ahead, 0)
                prefetch(box, g_ahead, 0)
                prefetch(features, g_ahead, 0)
                prefetch(opacity, g_ahead, 0)
                g = np.uint64(ids[k])
                k += 1
                xc, yc = geo[g, 0], geo[g, 1]
                ux, uy, vx, vy = EXP2_SCALE * geo[g, 2], EXP2_SCALE * geo[g, 3], EXP2_SCALE * geo[g, 4], EXP2_SCALE * geo[g, 5]
                wx, wy, zc = geo[g, 6], geo[g, 7], geo[g, 8]
                op = opacity[g]
                izc = _NDC_SCALE / zc
                rho_max = np.log2(np.float32(255.0) * op)
                n_hits, q_at = 0, np.uint64(0)
                x0, x1 = max(box[g, 0] - px, 0) // BLOCK_X, min(box[g, 1] - px, n_cols - 1) // BLOCK_X
                y0, y1 = max(box[g, 2] - py, 0) // BLOCK_Y, min(box[g, 3] - py, n_rows - 1) // BLOCK_Y
                for by in range(y0, y1 + 1):
                    dy = lane_row() + (np.float32(py + by * BLOCK_Y) + half - yc)
                    nu, nv, nw, n2 = dy * uy, dy * vy, dy * wy + ones, dy * dy
                    dx = lane_column() + (np.float32(px + x0 * BLOCK_X - BLOCK_X) + half - xc)
                    for b in range(by * BLOCKS_ACROSS + x0, by * BLOCKS_ACROSS + x1 + 1):
                        dx = dx + step
                        if not active[b]:
                            continue
                        base = np.uint64(b) * block_size
                        den = wx * dx + nw
                        inv = ones / den
                        u = (ux * dx + nu) * inv
                        v = (vx * dx + nv) * inv
                        r3 = u * u + v * v
                        r2 = low_pass * (dx * dx + n2)
                        on_plane = (r3 <= r2) & (den > t_min)
                        rho = select(on_plane, r3, r2)
                        valid = (rho <= rho_max) & (load(s, base + o_t) >= t_min)
                        alpha = op * exp2(zero - rho, ones, p1, p2, p3, p4, p5)
                        # no branch on `on`, which the processor could not foresee: a block without a hit is overwritten by the next
                        store(q, q_at, select(valid, select(alpha < alpha_max, alpha, alpha_max), zero))
                        store(q, q_at + n8, zc * select(on_plane, inv, ones))
                        store(q, q_at + n16, iz0 - izc * select(on_plane, den, ones))
                        hits[n_hits] = b
                        n_hits += any_lane(valid)
                        q_at = np.uint64(n_hits) * q_size
                for h in range(n_hits):
                    b = hits[h]
                    base, q_at = np.uint64(b) * block_size, np.uint64(h) * q_size
                    t = load(s, base + o_t)
                    w = load(q, q_at) * t
                    z, m = load(q, q_at + n8), load(q, q_at + n16)
                    t_next = t - w
                    b1, b2 = load(s, base + o_b1), load(s, base + o_b2)
                    wm = w * m
                    store(s, base + o_t, t_next)
                    store(s, base + o_z, load(s, base + o_z) + w * z)
                    store(s, base + o_d, load(s, base + o_d) + (wm * (m * (one - t) - two * b1) + w * b2))
                    store(s, base + o_b1, b1 + wm)
                    store(s, base + o_b2, b2 + wm * m)
                    # T crosses ½ once; adding keeps LLVM from a masked store (slow on AMD)
                    store(s, base + o_m, load(s, base + o_m) + select((t > half) & (t_next <= half), z, zero))
                    slot = base + o_f
                    for c in range(c_n):
                        store(s, slot, load(s, slot) + w * features[g, c])
                        slot += n8
                    if not any_lane(t_next >= t_min):
                        active[b] = False
                        n_active -= 1
            ends[tile] = k
            for c in range(channels):
                unpack(s, o_f + np.uint64(c * LANES), block_size, image, origin + np.uint64(c) * size, u_w, u_cols, u_rows)
            unpack(s, o_z, block_size, image, origin + np.uint64(channels) * size, u_w, u_cols, u_rows)
            unpack(s, o_d, block_size, image, origin + np.uint64(channels + 1) * size, u_w, u_cols, u_rows)
            unpack(s, o_b1, block_size, image, origin + np.uint64(channels + 2) * size, u_w, u_cols, u_rows)
            unpack(s, o_b2, block_size, image, origin + np.uint64(channels + 3) * size, u_w, u_cols, u_rows)
            for b in range(BLOCKS_ACROSS * BLOCKS_DOWN):
                at_t = np.uint64(b) * block_size + o_t
                store(s, at_t, one - load(s, at_t))
            unpack(s, o_t, block_size, image, origin + np.uint64(channels + 4) * size, u_w, u_cols, u_rows)
            unpack(s, o_m, block_size, image, origin + np.uint64(channels + 5) * size, u_w, u_cols, u_rows)

    def call(*args: Any) -> None:
        forward(*args, CONSTANTS)

    return call


@njit(**JIT)
def accumulate(a, at, value):  # type: ignore[no-untyped-def]
    """Add lanes to the `at`-th of an array. Not a closure of the kernel: a compiled function in a closure is another one in every process,
    and the kernel would never be found in the cache."""
    store(a, np.uint64(at * LANES), load(a, np.uint64(at * LANES)) + value)


@lru_cache(maxsize=16)
def backward_kernel(channels: int) -> Any:
    """Compiled backward: fills one gradient slot per (tile, surfel) pair, see the module's notes."""
    c_n = np.uint64(channels)
    q_w, q_e, q_u, q_v, q_inv, q_plane, q_z, q_m, q_dx, q_dy = (np.uint64(i * LANES) for i in range(10))
    q_size = np.uint64(10 * LANES)
    n8 = np.uint64(LANES)
    # per block: T, what lies behind, alpha, first and second moment, gradient planes (features, depth, distortion, alpha)
    o_t, o_suffix, o_a, o_b1, o_b2, o_g = (np.uint64(i * LANES) for i in range(6))
    o_gz, o_gd, o_ga = (np.uint64((5 + channels + i) * LANES) for i in range(AUX_GRADIENTS))
    block_size = np.uint64((5 + channels + AUX_GRADIENTS) * LANES)
    total_size = BLOCKS_ACROSS * BLOCKS_DOWN * int(block_size)
    acc_f = np.uint64(FEATURE_OFFSET * LANES)
    acc_size = (FEATURE_OFFSET + channels) * LANES
    zero, half, one, two = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)

    @kernel(
        "i8[::1], i8, i8, i8[::1], i4[::1], i8[::1], f4[:, ::1], i4[:, ::1], f4[::1], f4[:, ::1], i8, i8, i8, f4[:, :, ::1], i8[::1], "
        "f4[:, :, ::1], f4[:, ::1], f4[::1]",
        **JIT,
    )
    def backward(  # type: ignore[no-untyped-def]
        order, lo, hi, starts, ids, slots, geo, box, opacity, features, width, height, tiles_x, out, ends, grad, result, constants
    ):
        s = np.empty(total_size, np.float32)
        ones, p1, p2 = broadcast(constants[0]), broadcast(constants[1]), broadcast(constants[2])
        p3, p4, p5 = broadcast(constants[3]), broadcast(constants[4]), broadcast(constants[5])
        alpha_max, t_min, low_pass, ln2 = broadcast(constants[6]), broadcast(constants[7]), broadcast(constants[8]), broadcast(constants[9])
        image, grad_planes = out.reshape(out.size), grad.reshape(grad.size)
        u_w, size = np.uint64(width), np.uint64(width * height)
        a = np.zeros(acc_size, np.float32)
        step = np.float32(BLOCK_X)
        hits = np.empty(BLOCKS_ACROSS * BLOCKS_DOWN + 1, np.uint64)
        q = np.empty((BLOCKS_ACROSS * BLOCKS_DOWN + 1) * int(q_size), np.float32)
        active = np.empty(BLOCKS_ACROSS * BLOCKS_DOWN, np.bool_)
        for i in range(lo, hi):
            tile = order[i]
            ty = tile // tiles_x
            tx = tile - ty * tiles_x
            px, py = tx * TILE, ty * TILE
            n_cols, n_rows = min(TILE, width - px), min(TILE, height - py)
            origin, u_cols, u_rows = np.uint64(py * width + px), np.uint64(n_cols), np.uint64(n_rows)
            s[:] = zero
            for b in range(BLOCKS_ACROSS * BLOCKS_DOWN):
                active[b] = ((b // BLOCKS_ACROSS) * BLOCK_Y < n_rows) & ((b % BLOCKS_ACROSS) * BLOCK_X < n_cols)
            for c in range(channels + AUX_GRADIENTS):
                # what lies behind: Σ gradient · output over all planes; distortion is of second order in the weights
                source = c if c < channels + 2 else channels + 4
                at_g = o_g + np.uint64(c * LANES)
                pack(grad_planes, origin + np.uint64(source) * size, u_w, s, at_g, block_size, u_cols, u_rows)
                pack(image, origin + np.uint64(source) * size, u_w, s, o_t, block_size, u_cols, u_rows)
                factor = two if c == channels + 1 else one
                for b in range(BLOCKS_ACROSS * BLOCKS_DOWN):
                    base = np.uint64(b) * block_size
                    store(s, base + o_suffix, load(s, base + o_suffix) + factor * load(s, base + at_g) * load(s, base + o_t))
            pack(image, origin + np.uint64(channels + 4) * size, u_w, s, o_a, block_size, u_cols, u_rows)
            pack(image, origin + np.uint64(channels + 2) * size, u_w, s, o_b1, block_size, u_cols, u_rows)
            pack(image, origin + np.uint64(channels + 3) * size, u_w, s, o_b2, block_size, u_cols, u_rows)
            for y in range(n_rows):
                for x in range(n_cols):
                    b = (y // BLOCK_Y) * BLOCKS_ACROSS + x // BLOCK_X
                    s[np.uint64(b) * block_size + o_t + np.uint64((y % BLOCK_Y) * BLOCK_X + x % BLOCK_X)] = one
            begin, end = starts[tile], ends[tile]
            iz0 = zero
            if end > begin:
                iz0 = _NDC_SCALE / geo[ids[begin], 8]
            for k in range(begin, end):
                k_ahead = min(k + 3, end - 1)
                g_ahead = np.uint64(ids[k_ahead])
                prefetch(geo, g_ahead, 0)
                prefetch(box, g_ahead, 0)
                prefetch(features, g_ahead, 0)
                prefetch(opacity, g_ahead, 0)
                prefetch(result, np.uint64(slots[k_ahead]), 1)
                g = np.uint64(ids[k])
                slot = slots[k]
                xc, yc = geo[g, 0], geo[g, 1]
                ux, uy, vx, vy = EXP2_SCALE * geo[g, 2], EXP2_SCALE * geo[g, 3], EXP2_SCALE * geo[g, 4], EXP2_SCALE * geo[g, 5]
                wx, wy, zc = geo[g, 6], geo[g, 7], geo[g, 8]
                op = opacity[g]
                izc = _NDC_SCALE / zc
                rho_max = np.log2(np.float32(255.0) * op)
                x0, x1 = max(box[g, 0] - px, 0) // BLOCK_X, min(box[g, 1] - px, n_cols - 1) // BLOCK_X
                y0, y1 = max(box[g, 2] - py, 0) // BLOCK_Y, min(box[g, 3] - py, n_rows - 1) // BLOCK_Y
                op2 = np.float32(-2.0) * op
                n_hits, q_at = 0, np.uint64(0)
                for by in range(y0, y1 + 1):
                    dy = lane_row() + (np.float32(py + by * BLOCK_Y) + half - yc)
                    nu, nv, nw, n2 = dy * uy, dy * vy, dy * wy + ones, dy * dy
                    dx = lane_column() + (np.float32(px + x0 * BLOCK_X - BLOCK_X) + half - xc)
                    for b in range(by * BLOCKS_ACROSS + x0, by * BLOCKS_ACROSS + x1 + 1):
                        dx = dx + step
                        if not active[b]:
                            continue
                        base = np.uint64(b) * block_size
                        den = wx * dx + nw
                        in_front = den > t_min
                        inv = ones / select(in_front, den, ones)
                        u = (ux * dx + nu) * inv
                        v = (vx * dx + nv) * inv
                        r3 = u * u + v * v
                        r2 = low_pass * (dx * dx + n2)
                        on_plane = (r3 <= r2) & in_front
                        rho = select(on_plane, r3, r2)
                        valid = (rho <= rho_max) & (load(s, base + o_t) >= t_min)
                        e = exp2(zero - rho, ones, p1, p2, p3, p4, p5)
                        raw = op * e
                        store(q, q_at + q_w, select(valid, select(raw < alpha_max, raw, alpha_max), zero))
                        # gradient of α reaches ρ and o only where α is neither clamped nor skipped
                        store(q, q_at + q_e, select(valid & (raw < alpha_max), e, zero))
                        store(q, q_at + q_u, u)
                        store(q, q_at + q_v, v)
                        store(q, q_at + q_inv, select(on_plane, inv, zero))
                        store(q, q_at + q_plane, select(on_plane, ones, zero))
                        store(q, q_at + q_z, zc * select(on_plane, inv, ones))
                        store(q, q_at + q_m, izc * select(on_plane, den, ones))
                        store(q, q_at + q_dx, dx)
                        store(q, q_at + q_dy, dy)
                        hits[n_hits] = b
                        n_hits += any_lane(valid)
                        q_at = np.uint64(n_hits) * q_size
                for h in range(n_hits):
                    b = hits[h]
                    base, q_at = np.uint64(b) * block_size, np.uint64(h) * q_size
                    t, alpha, z, iz = load(s, base + o_t), load(q, q_at + q_w), load(q, q_at + q_z), load(q, q_at + q_m)
                    w = alpha * t
                    t_next = t - w
                    m = iz0 - iz
                    sum_w, sum_wm = load(s, base + o_a), load(s, base + o_b1)
                    g_depth, g_distortion = load(s, base + o_gz), load(s, base + o_gd)
                    gw = load(s, base + o_ga) + g_depth * z + g_distortion * (m * (m * sum_w - two * sum_wm) + load(s, base + o_b2))
                    plane_c, acc_c = base + o_g, acc_f
                    for c in range(c_n):
                        gc = load(s, plane_c)
                        gw = gw + gc * features[g, c]
                        store(a, acc_c, load(a, acc_c) + gc * w)
                        plane_c += n8
                        acc_c += n8
                    suffix = load(s, base + o_suffix) - w * gw
                    store(s, base + o_suffix, suffix)
                    store(s, base + o_t, t_next)
                    active[b] = any_lane(t_next >= t_min)
                    g_op = (t * gw - suffix / (ones - alpha)) * load(q, q_at + q_e)
                    gz = w * g_depth * z
                    gm = two * (w * g_distortion * (m * sum_w - sum_wm))
                    store(q, q_at + q_e, g_op)
                    store(q, q_at + q_z, gz)
                    store(q, q_at + q_m, gm)
                    accumulate(a, 8, gz + gm * iz)
                    accumulate(a, 9, g_op)
                    accumulate(a, 10, w)
                s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = broadcast(zero)
                for h in range(n_hits):
                    q_at = np.uint64(h) * q_size
                    g_rho, inv, on_plane = load(q, q_at + q_e) * op2, load(q, q_at + q_inv), load(q, q_at + q_plane)
                    u, v, dx, dy = load(q, q_at + q_u), load(q, q_at + q_v), load(q, q_at + q_dx), load(q, q_at + q_dy)
                    g_uv = ln2 * g_rho * inv
                    g_lp = g_rho - g_rho * on_plane
                    gui, gvi = g_uv * u, g_uv * v
                    g_den = gui * u + gvi * v + load(q, q_at + q_z) * inv + load(q, q_at + q_m) * izc * on_plane
                    s0 = s0 + (g_lp * dx + (gui * ux + gvi * vx - g_den * wx))
                    s1 = s1 + (g_lp * dy + (gui * uy + gvi * vy - g_den * wy))
                    s2 = s2 + gui * dx
                    s3 = s3 + gui * dy
                    s4 = s4 + gvi * dx
                    s5 = s5 + gvi * dy
                    s6 = s6 + g_den * dx
                    s7 = s7 + g_den * dy
                if n_hits > 0:
                    result[slot, 0], result[slot, 1] = -sum_lanes(s0), -sum_lanes(s1)
                    result[slot, 2], result[slot, 3] = EXP2_SCALE * sum_lanes(s2), EXP2_SCALE * sum_lanes(s3)
                    result[slot, 4], result[slot, 5] = EXP2_SCALE * sum_lanes(s4), EXP2_SCALE * sum_lanes(s5)
                    result[slot, 6], result[slot, 7] = -sum_lanes(s6), -sum_lanes(s7)
                    for j in range(8, FEATURE_OFFSET + channels):
                        at_j = np.uint64(j * LANES)
                        result[slot, j] = sum_lanes(load(a, at_j))
                        store(a, at_j, broadcast(zero))
                    result[slot, 8] *= one / zc
                else:
                    for j in range(FEATURE_OFFSET + channels):
                        result[slot, j] = zero
            for k in range(end, starts[tile + 1]):
                for j in range(FEATURE_OFFSET + channels):
                    result[slots[k], j] = zero

    def call(*args: Any) -> None:
        backward(*args, CONSTANTS)

    return call


@kernel("i8, i8, i8[::1], f4[:, ::1], f4[:, ::1]", **JIT)
def sum_slots(lo, hi, offsets, result, sums):  # type: ignore[no-untyped-def]
    """Sum each surfel's gradient slots (contiguous in `result`) into `sums` (n, SLOT + channels)."""
    n_j = result.shape[1]
    for g in range(lo, hi):
        for j in range(n_j):
            sums[g, j] = np.float32(0.0)
        for k in range(offsets[g], offsets[g + 1]):
            for j in range(n_j):
                sums[g, j] += result[k, j]


#: Features of the surfels in the profiles for assets: colours or a material, and the normals.
USUAL_CHANNELS = (6,)
also_built_by(__name__, *(partial(build, channels) for channels in USUAL_CHANNELS for build in (forward_kernel, backward_kernel)))
