"""The tile rasteriser in Numba: forward and backward over 16x16 tiles, blocks of 4x2 pixels as SIMD lanes.

A surfel on screen is nine numbers (Huang et al., 2DGS, SIGGRAPH 2024, in centre-relative form): with dx = x − xc, dy = y − yc and
den = 1 + wx dx + wy dy, the plane hit is u = (ux dx + uy dy)/den, v = (vx dx + vy dy)/den and the depth is z = zc/den. Weighting is
ρ = min(u² + v², 2 (dx² + dy²)); α = min(.99, o e^{−ρ/2}), skipped below 1/255; a pixel stops once its transmittance is below 1e-4.

Backward walks front to back: what still lies behind a surfel is the total minus the prefix, so nothing is stored per pixel and surfel. Each
(tile, surfel) pair writes its gradient into a slot of its own, summed per surfel afterwards: no atomics, and the result does not
depend on threads.

All per-pixel arithmetic is in `lanes`. `fastmath` leaves NaN alone ("nnan" would let a NaN pass every guard and crash).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from gsbake.surfels.raster.blocks import ACROSS, DOWN, JIT, TILE, pack, unpack
from gsbake.surfels.raster.lanes import (
    BLOCK_X,
    BLOCK_Y,
    LANES,
    POWER,
    lane_column,
    lane_row,
    lanes,
    load,
    power_of_two,
    prefetch,
    select,
    some,
    store,
    total,
)

GEO = 9  # xc, yc, ux, uy, vx, vy, wx, wy, zc
EXTRA = 6  # planes behind the features: depth, distortion, first and second moment, alpha, median depth
GRADS = 3  # of their gradients these count: depth, distortion, alpha
SLOT = 11  # gradient slot before the features: 9 coefficients, opacity, accumulated weight
NEAR, FAR = 0.2, 100.0
NDC = FAR * NEAR / (FAR - NEAR)
NDC32 = np.float32(NDC)
T_STOP = 1e-4
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
#: u and v are scaled by √(½ log₂ e), so that e^{−ρ/2} is 2^{−(u² + v²)}; the low-pass disc's 2 d² becomes log₂ e d².
SCALE, LOW_PASS = np.float32(math.sqrt(0.5 / math.log(2.0))), np.float32(1.0 / math.log(2.0))
#: Handed to the kernels as an array: constants that LLVM knows are fetched anew, address and all, in every round of the inner loop.
CONSTANTS = np.array([*POWER, ALPHA_MAX, T_STOP, LOW_PASS, math.log(2.0)], np.float32)


@lru_cache(maxsize=16)
def forward_kernel(channels: int) -> Any:
    """Compiled forward for one feature count: `f(order, lo, hi, starts, ids, geo, box, opacity, features, width, height, tiles_x,
    out, used)`."""
    c_n = np.uint64(channels)
    block_size = np.uint64((EXTRA + channels) * LANES)
    total_size = ACROSS * DOWN * int(block_size)
    n8, n16, q_size = np.uint64(LANES), np.uint64(2 * LANES), np.uint64(3 * LANES)
    o_t, o_z, o_d, o_b1, o_b2, o_m, o_f = (np.uint64(i * LANES) for i in range(7))
    zero, half, one, two = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)

    @njit(**JIT)
    def forward(order, lo, hi, starts, ids, geo, box, opacity, features, width, height, tiles_x, out, used, constants):  # type: ignore[no-untyped-def]
        s = np.empty(total_size, np.float32)
        one_, p1, p2 = lanes(constants[0]), lanes(constants[1]), lanes(constants[2])
        p3, p4, p5 = lanes(constants[3]), lanes(constants[4]), lanes(constants[5])
        a_max, least, low_pass = lanes(constants[6]), lanes(constants[7]), lanes(constants[8])
        image, u_w, size = out.reshape(out.size), np.uint64(width), np.uint64(width * height)
        step = np.float32(BLOCK_X)
        live = np.empty(ACROSS * DOWN, np.bool_)
        hit = np.empty(ACROSS * DOWN + 1, np.uint64)
        q = np.empty((ACROSS * DOWN + 1) * int(q_size), np.float32)
        for at in range(lo, hi):
            tile = order[at]
            ty = tile // tiles_x
            tx = tile - ty * tiles_x
            px, py = tx * TILE, ty * TILE
            n_cols, n_rows = min(TILE, width - px), min(TILE, height - py)
            corner, u_cols, u_rows = np.uint64(py * width + px), np.uint64(n_cols), np.uint64(n_rows)
            s[:] = zero
            for y in range(n_rows):  # pixels beyond the frame keep T = 0
                for x in range(n_cols):
                    b = (y // BLOCK_Y) * ACROSS + x // BLOCK_X
                    s[np.uint64(b) * block_size + o_t + np.uint64((y % BLOCK_Y) * BLOCK_X + x % BLOCK_X)] = one
            n_live = 0
            for b in range(ACROSS * DOWN):
                live[b] = ((b // ACROSS) * BLOCK_Y < n_rows) & ((b % ACROSS) * BLOCK_X < n_cols)
                n_live += live[b]
            begin, end = starts[tile], starts[tile + 1]
            k = begin
            iz0 = zero
            if end > begin:
                iz0 = NDC32 / geo[ids[begin], 8]
            while k < end and n_live > 0:
                ahead_k = min(k + 3, end - 1)
                nxt = np.uint64(ids[ahead_k])
                prefetch(geo, nxt, 0)
                prefetch(box, nxt, 0)
                prefetch(features, nxt, 0)
                prefetch(opacity, nxt, 0)
                g = np.uint64(ids[k])
                k += 1
                xc, yc = geo[g, 0], geo[g, 1]
                ux, uy, vx, vy = SCALE * geo[g, 2], SCALE * geo[g, 3], SCALE * geo[g, 4], SCALE * geo[g, 5]
                wx, wy, zc = geo[g, 6], geo[g, 7], geo[g, 8]
                op = opacity[g]
                izc = NDC32 / zc
                cut = np.log2(np.float32(255.0) * op)
                n_hit, q_at = 0, np.uint64(0)
                x0, x1 = max(box[g, 0] - px, 0) // BLOCK_X, min(box[g, 1] - px, n_cols - 1) // BLOCK_X
                y0, y1 = max(box[g, 2] - py, 0) // BLOCK_Y, min(box[g, 3] - py, n_rows - 1) // BLOCK_Y
                for by in range(y0, y1 + 1):
                    dy = lane_row() + (np.float32(py + by * BLOCK_Y) + half - yc)
                    nu, nv, nw, n2 = dy * uy, dy * vy, dy * wy + one_, dy * dy
                    dx = lane_column() + (np.float32(px + x0 * BLOCK_X - BLOCK_X) + half - xc)
                    for b in range(by * ACROSS + x0, by * ACROSS + x1 + 1):
                        dx = dx + step
                        if not live[b]:
                            continue
                        base = np.uint64(b) * block_size
                        den = wx * dx + nw
                        inv = one_ / den
                        u = (ux * dx + nu) * inv
                        v = (vx * dx + nv) * inv
                        r3 = u * u + v * v
                        r2 = low_pass * (dx * dx + n2)
                        plane = (r3 <= r2) & (den > least)
                        rho = select(plane, r3, r2)
                        on = (rho <= cut) & (load(s, base + o_t) >= least)
                        alpha = op * power_of_two(zero - rho, one_, p1, p2, p3, p4, p5)
                        # no branch on `on`, which the processor could not foresee: a block without a hit is overwritten by the next
                        store(q, q_at, select(on, select(alpha < a_max, alpha, a_max), zero))
                        store(q, q_at + n8, zc * select(plane, inv, one_))
                        store(q, q_at + n16, iz0 - izc * select(plane, den, one_))
                        hit[n_hit] = b
                        n_hit += some(on)
                        q_at = np.uint64(n_hit) * q_size
                for h in range(n_hit):
                    b = hit[h]
                    base, q_at = np.uint64(b) * block_size, np.uint64(h) * q_size
                    t = load(s, base + o_t)
                    w = load(q, q_at) * t
                    z, m = load(q, q_at + n8), load(q, q_at + n16)
                    tn = t - w
                    b1, b2 = load(s, base + o_b1), load(s, base + o_b2)
                    wm = w * m
                    store(s, base + o_t, tn)
                    store(s, base + o_z, load(s, base + o_z) + w * z)
                    store(s, base + o_d, load(s, base + o_d) + (wm * (m * (one - t) - two * b1) + w * b2))
                    store(s, base + o_b1, b1 + wm)
                    store(s, base + o_b2, b2 + wm * m)
                    # T crosses ½ once; adding keeps LLVM from a masked store (slow on AMD)
                    store(s, base + o_m, load(s, base + o_m) + select((t > half) & (tn <= half), z, zero))
                    slot = base + o_f
                    for c in range(c_n):
                        store(s, slot, load(s, slot) + w * features[g, c])
                        slot += n8
                    if not some(tn >= least):
                        live[b] = False
                        n_live -= 1
            used[tile] = k
            for c in range(channels):
                unpack(s, o_f + np.uint64(c * LANES), block_size, image, corner + np.uint64(c) * size, u_w, u_cols, u_rows)
            unpack(s, o_z, block_size, image, corner + np.uint64(channels) * size, u_w, u_cols, u_rows)
            unpack(s, o_d, block_size, image, corner + np.uint64(channels + 1) * size, u_w, u_cols, u_rows)
            unpack(s, o_b1, block_size, image, corner + np.uint64(channels + 2) * size, u_w, u_cols, u_rows)
            unpack(s, o_b2, block_size, image, corner + np.uint64(channels + 3) * size, u_w, u_cols, u_rows)
            for b in range(ACROSS * DOWN):
                at_t = np.uint64(b) * block_size + o_t
                store(s, at_t, one - load(s, at_t))
            unpack(s, o_t, block_size, image, corner + np.uint64(channels + 4) * size, u_w, u_cols, u_rows)
            unpack(s, o_m, block_size, image, corner + np.uint64(channels + 5) * size, u_w, u_cols, u_rows)

    def call(*args: Any) -> None:
        forward(*args, CONSTANTS)

    return call


@njit(**JIT)
def add(a, at, value):  # type: ignore[no-untyped-def]
    """Add lanes to the `at`-th of an array. Not a closure of the kernel: a compiled function in a closure is another one in every process,
    and the kernel would never be found in the cache."""
    store(a, np.uint64(at * LANES), load(a, np.uint64(at * LANES)) + value)


@lru_cache(maxsize=16)
def backward_kernel(channels: int) -> Any:
    """Compiled backward: fills one gradient slot per (tile, surfel) pair, see the module's notes."""
    c_n = np.uint64(channels)
    q_w, q_e, q_u, q_v, q_inv, q_flat, q_z, q_m, q_dx, q_dy = (np.uint64(i * LANES) for i in range(10))
    q_size = np.uint64(10 * LANES)
    n8 = np.uint64(LANES)
    # per block: T, what lies behind, alpha, first and second moment, gradient planes (features, depth, distortion, alpha)
    o_t, o_r, o_a, o_b1, o_b2, o_g = (np.uint64(i * LANES) for i in range(6))
    o_gz, o_gd, o_ga = (np.uint64((5 + channels + i) * LANES) for i in range(GRADS))
    block_size = np.uint64((5 + channels + GRADS) * LANES)
    total_size = ACROSS * DOWN * int(block_size)
    acc_f = np.uint64(SLOT * LANES)
    acc_size = (SLOT + channels) * LANES
    zero, half, one, two = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)

    @njit(**JIT)
    def backward(  # type: ignore[no-untyped-def]
        order, lo, hi, starts, ids, slots, geo, box, opacity, features, width, height, tiles_x, out, used, grad, result, constants
    ):
        s = np.empty(total_size, np.float32)
        one_, p1, p2 = lanes(constants[0]), lanes(constants[1]), lanes(constants[2])
        p3, p4, p5 = lanes(constants[3]), lanes(constants[4]), lanes(constants[5])
        a_max, least, low_pass, ln2 = lanes(constants[6]), lanes(constants[7]), lanes(constants[8]), lanes(constants[9])
        image, slope = out.reshape(out.size), grad.reshape(grad.size)
        u_w, size = np.uint64(width), np.uint64(width * height)
        a = np.zeros(acc_size, np.float32)
        step = np.float32(BLOCK_X)
        hit = np.empty(ACROSS * DOWN + 1, np.uint64)
        q = np.empty((ACROSS * DOWN + 1) * int(q_size), np.float32)
        live = np.empty(ACROSS * DOWN, np.bool_)
        for at in range(lo, hi):
            tile = order[at]
            ty = tile // tiles_x
            tx = tile - ty * tiles_x
            px, py = tx * TILE, ty * TILE
            n_cols, n_rows = min(TILE, width - px), min(TILE, height - py)
            corner, u_cols, u_rows = np.uint64(py * width + px), np.uint64(n_cols), np.uint64(n_rows)
            s[:] = zero
            for b in range(ACROSS * DOWN):
                live[b] = ((b // ACROSS) * BLOCK_Y < n_rows) & ((b % ACROSS) * BLOCK_X < n_cols)
            for c in range(channels + GRADS):
                # what lies behind: Σ gradient · output over all planes; distortion is of second order in the weights
                source = c if c < channels + 2 else channels + 4
                at_g = o_g + np.uint64(c * LANES)
                pack(slope, corner + np.uint64(source) * size, u_w, s, at_g, block_size, u_cols, u_rows)
                pack(image, corner + np.uint64(source) * size, u_w, s, o_t, block_size, u_cols, u_rows)
                factor = two if c == channels + 1 else one
                for b in range(ACROSS * DOWN):
                    base = np.uint64(b) * block_size
                    store(s, base + o_r, load(s, base + o_r) + factor * load(s, base + at_g) * load(s, base + o_t))
            pack(image, corner + np.uint64(channels + 4) * size, u_w, s, o_a, block_size, u_cols, u_rows)
            pack(image, corner + np.uint64(channels + 2) * size, u_w, s, o_b1, block_size, u_cols, u_rows)
            pack(image, corner + np.uint64(channels + 3) * size, u_w, s, o_b2, block_size, u_cols, u_rows)
            for y in range(n_rows):
                for x in range(n_cols):
                    b = (y // BLOCK_Y) * ACROSS + x // BLOCK_X
                    s[np.uint64(b) * block_size + o_t + np.uint64((y % BLOCK_Y) * BLOCK_X + x % BLOCK_X)] = one
            begin, end = starts[tile], used[tile]
            iz0 = zero
            if end > begin:
                iz0 = NDC32 / geo[ids[begin], 8]
            for k in range(begin, end):
                ahead_k = min(k + 3, end - 1)
                nxt = np.uint64(ids[ahead_k])
                prefetch(geo, nxt, 0)
                prefetch(box, nxt, 0)
                prefetch(features, nxt, 0)
                prefetch(opacity, nxt, 0)
                prefetch(result, np.uint64(slots[ahead_k]), 1)
                g = np.uint64(ids[k])
                slot = slots[k]
                xc, yc = geo[g, 0], geo[g, 1]
                ux, uy, vx, vy = SCALE * geo[g, 2], SCALE * geo[g, 3], SCALE * geo[g, 4], SCALE * geo[g, 5]
                wx, wy, zc = geo[g, 6], geo[g, 7], geo[g, 8]
                op = opacity[g]
                izc = NDC32 / zc
                cut = np.log2(np.float32(255.0) * op)
                x0, x1 = max(box[g, 0] - px, 0) // BLOCK_X, min(box[g, 1] - px, n_cols - 1) // BLOCK_X
                y0, y1 = max(box[g, 2] - py, 0) // BLOCK_Y, min(box[g, 3] - py, n_rows - 1) // BLOCK_Y
                op2 = np.float32(-2.0) * op
                n_hit, q_at = 0, np.uint64(0)
                for by in range(y0, y1 + 1):
                    dy = lane_row() + (np.float32(py + by * BLOCK_Y) + half - yc)
                    nu, nv, nw, n2 = dy * uy, dy * vy, dy * wy + one_, dy * dy
                    dx = lane_column() + (np.float32(px + x0 * BLOCK_X - BLOCK_X) + half - xc)
                    for b in range(by * ACROSS + x0, by * ACROSS + x1 + 1):
                        dx = dx + step
                        if not live[b]:
                            continue
                        base = np.uint64(b) * block_size
                        den = wx * dx + nw
                        ahead = den > least
                        inv = one_ / select(ahead, den, one_)
                        u = (ux * dx + nu) * inv
                        v = (vx * dx + nv) * inv
                        r3 = u * u + v * v
                        r2 = low_pass * (dx * dx + n2)
                        plane = (r3 <= r2) & ahead
                        rho = select(plane, r3, r2)
                        on = (rho <= cut) & (load(s, base + o_t) >= least)
                        e = power_of_two(zero - rho, one_, p1, p2, p3, p4, p5)
                        raw = op * e
                        store(q, q_at + q_w, select(on, select(raw < a_max, raw, a_max), zero))
                        # gradient of α reaches ρ and o only where α is neither clamped nor skipped
                        store(q, q_at + q_e, select(on & (raw < a_max), e, zero))
                        store(q, q_at + q_u, u)
                        store(q, q_at + q_v, v)
                        store(q, q_at + q_inv, select(plane, inv, zero))
                        store(q, q_at + q_flat, select(plane, one_, zero))
                        store(q, q_at + q_z, zc * select(plane, inv, one_))
                        store(q, q_at + q_m, izc * select(plane, den, one_))
                        store(q, q_at + q_dx, dx)
                        store(q, q_at + q_dy, dy)
                        hit[n_hit] = b
                        n_hit += some(on)
                        q_at = np.uint64(n_hit) * q_size
                for h in range(n_hit):
                    b = hit[h]
                    base, q_at = np.uint64(b) * block_size, np.uint64(h) * q_size
                    t, alpha, z, iz = load(s, base + o_t), load(q, q_at + q_w), load(q, q_at + q_z), load(q, q_at + q_m)
                    w = alpha * t
                    tn = t - w
                    m = iz0 - iz
                    p_a, p_b1, p_gz, p_gd = load(s, base + o_a), load(s, base + o_b1), load(s, base + o_gz), load(s, base + o_gd)
                    gw = load(s, base + o_ga) + p_gz * z + p_gd * (m * (m * p_a - two * p_b1) + load(s, base + o_b2))
                    plane_c, acc_c = base + o_g, acc_f
                    for c in range(c_n):
                        gc = load(s, plane_c)
                        gw = gw + gc * features[g, c]
                        store(a, acc_c, load(a, acc_c) + gc * w)
                        plane_c += n8
                        acc_c += n8
                    rest = load(s, base + o_r) - w * gw
                    store(s, base + o_r, rest)
                    store(s, base + o_t, tn)
                    live[b] = some(tn >= least)
                    g_op = (t * gw - rest / (one_ - alpha)) * load(q, q_at + q_e)
                    gz = w * p_gz * z
                    gm = two * (w * p_gd * (m * p_a - p_b1))
                    store(q, q_at + q_e, g_op)
                    store(q, q_at + q_z, gz)
                    store(q, q_at + q_m, gm)
                    add(a, 8, gz + gm * iz)
                    add(a, 9, g_op)
                    add(a, 10, w)
                s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = lanes(zero)
                for h in range(n_hit):
                    q_at = np.uint64(h) * q_size
                    g_rho, inv, flat = load(q, q_at + q_e) * op2, load(q, q_at + q_inv), load(q, q_at + q_flat)
                    u, v, dx, dy = load(q, q_at + q_u), load(q, q_at + q_v), load(q, q_at + q_dx), load(q, q_at + q_dy)
                    g_uv = ln2 * g_rho * inv
                    g_lp = g_rho - g_rho * flat
                    gui, gvi = g_uv * u, g_uv * v
                    g_den = gui * u + gvi * v + load(q, q_at + q_z) * inv + load(q, q_at + q_m) * izc * flat
                    s0 = s0 + (g_lp * dx + (gui * ux + gvi * vx - g_den * wx))
                    s1 = s1 + (g_lp * dy + (gui * uy + gvi * vy - g_den * wy))
                    s2 = s2 + gui * dx
                    s3 = s3 + gui * dy
                    s4 = s4 + gvi * dx
                    s5 = s5 + gvi * dy
                    s6 = s6 + g_den * dx
                    s7 = s7 + g_den * dy
                if n_hit > 0:
                    result[slot, 0], result[slot, 1] = -total(s0), -total(s1)
                    result[slot, 2], result[slot, 3] = SCALE * total(s2), SCALE * total(s3)
                    result[slot, 4], result[slot, 5] = SCALE * total(s4), SCALE * total(s5)
                    result[slot, 6], result[slot, 7] = -total(s6), -total(s7)
                    for j in range(8, SLOT + channels):
                        at_j = np.uint64(j * LANES)
                        result[slot, j] = total(load(a, at_j))
                        store(a, at_j, lanes(zero))
                    result[slot, 8] *= one / zc
                else:
                    for j in range(SLOT + channels):
                        result[slot, j] = zero
            for k in range(end, starts[tile + 1]):
                for j in range(SLOT + channels):
                    result[slots[k], j] = zero

    def call(*args: Any) -> None:
        backward(*args, CONSTANTS)

    return call


@njit(**JIT)
def sum_slots(lo, hi, offsets, result, sums):  # type: ignore[no-untyped-def]
    """Sum each surfel's gradient slots (contiguous in `result`) into `sums` (n, SLOT + channels)."""
    n_j = result.shape[1]
    for g in range(lo, hi):
        for j in range(n_j):
            sums[g, j] = np.float32(0.0)
        for k in range(offsets[g], offsets[g + 1]):
            for j in range(n_j):
                sums[g, j] += result[k, j]
