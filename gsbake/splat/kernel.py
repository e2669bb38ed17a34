"""The tile rasteriser in Numba: forward and backward over 16x16 tiles, rows of 8 pixels as SIMD lanes.

A surfel on screen is nine numbers (Huang et al., 2DGS, SIGGRAPH 2024, in centre-relative form): with dx = x − xc, dy = y − yc and
den = 1 + wx dx + wy dy, the plane hit is u = (ux dx + uy dy)/den, v = (vx dx + vy dy)/den and the depth is z = zc/den. Weighting is
ρ = min(u² + v², 2 (dx² + dy²)); α = min(.99, o e^{−ρ/2}), skipped below 1/255; a pixel stops once its transmittance is below 1e-4.

Backward walks front to back: what still lies behind a surfel is the total minus the prefix, so nothing is stored per pixel and surfel. Each
(tile, surfel) pair writes its gradient into a slot of its own, summed per surfel afterwards: no atomics, and the result does not
depend on threads.

Written for LLVM's vectoriser: `error_model="numpy"`, unsigned indices, one scratch buffer with constant offsets, selects instead of
branches.
`fastmath` leaves NaN alone ("nnan" would let a NaN pass every guard and crash).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

TILE = 16
LANES = 8
GEO = 9  # xc, yc, ux, uy, vx, vy, wx, wy, zc
EXTRA = 6  # planes behind the features: depth, distortion, first and second moment, alpha, median depth
GRADS = 3  # gradient planes behind the features': depth, distortion, alpha
SLOT = 11  # gradient slot before the features: 9 coefficients, opacity, accumulated weight
NEAR, FAR = 0.2, 100.0
NDC = FAR * NEAR / (FAR - NEAR)
NDC32 = np.float32(NDC)
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}
T_STOP = 1e-4
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99

JIT: dict[str, Any] = {"nogil": True, "fastmath": FAST, "error_model": "numpy", "cache": True, "boundscheck": False}


@njit(**JIT)
def _exp_neg(t):  # type: ignore[no-untyped-def]
    """exp(−t) for t ≥ 0, clamped at 8: degree-6 polynomial of t/16, then four squarings."""
    y = np.float32(-0.0625) * (t if t < np.float32(8.0) else np.float32(8.0))
    p = np.float32(1.0 / 720.0)
    p = p * y + np.float32(1.0 / 120.0)
    p = p * y + np.float32(1.0 / 24.0)
    p = p * y + np.float32(1.0 / 6.0)
    p = p * y + np.float32(0.5)
    p = p * y + np.float32(1.0)
    p = p * y + np.float32(1.0)
    p = p * p
    p = p * p
    p = p * p
    return p * p


@lru_cache(maxsize=16)
def forward_kernel(channels: int) -> Any:
    """Compiled forward for one feature count: `f(order, lo, hi, starts, ids, geo, rows, opacity, features, width, height, tiles_x,
    out, used)`."""
    c_n = np.uint64(channels)
    row_size = np.uint64((EXTRA + 2 + channels) * LANES)
    half_size = np.uint64(TILE) * row_size
    n8 = np.uint64(LANES)
    o_t, o_z, o_d, o_b1, o_b2, o_m, o_w, o_f = (np.uint64(i * LANES) for i in range(8))

    @njit(**JIT)
    def forward(order, lo, hi, starts, ids, geo, box, opacity, features, width, height, tiles_x, out, used):  # type: ignore[no-untyped-def]
        s = np.empty(np.uint64(2) * half_size, np.float32)
        live = np.empty(2 * TILE, np.bool_)
        for at in range(lo, hi):
            tile = order[at]
            ty = tile // tiles_x
            tx = tile - ty * tiles_x
            px, py = tx * TILE, ty * TILE
            n_rows = min(TILE, height - py)
            s[:] = np.float32(0.0)
            for r in range(2 * TILE):
                base = np.uint64(r) * row_size
                n_x = min(LANES, width - px - (r // TILE) * LANES)  # lanes beyond the frame keep T = 0
                for x in range(n_x):
                    s[base + o_t + np.uint64(x)] = np.float32(1.0)
                live[r] = ((r % TILE) < n_rows) & (n_x > 0)
            begin, end = starts[tile], starts[tile + 1]
            k = begin
            iz0 = np.float32(0.0)
            if end > begin:
                iz0 = np.float32(1.0) / geo[ids[begin], 8]
            while k < end:
                g = np.uint64(ids[k])
                k += 1
                xc, yc = geo[g, 0], geo[g, 1]
                ux, uy, vx, vy = geo[g, 2], geo[g, 3], geo[g, 4], geo[g, 5]
                wx, wy, zc = geo[g, 6], geo[g, 7], geo[g, 8]
                op = opacity[g]
                izc = np.float32(1.0) / zc
                r0, r1 = max(box[g, 2] - py, 0), min(box[g, 3] - py, n_rows - 1)
                for half in range(2):
                    x0 = px + half * LANES
                    if box[g, 1] < x0 or box[g, 0] > x0 + LANES - 1:
                        continue
                    fx = np.float32(x0) + np.float32(0.5) - xc
                    for r in range(r0, r1 + 1):
                        if not live[half * TILE + r]:
                            continue
                        base = np.uint64(half) * half_size + np.uint64(r) * row_size
                        dy = np.float32(py + r) + np.float32(0.5) - yc
                        nu, nv, nw = uy * dy, vy * dy, np.float32(1.0) + wy * dy
                        dy2 = dy * dy
                        t_left = np.float32(0.0)
                        for x in range(n8):
                            dx = fx + np.float32(x)
                            den = nw + wx * dx
                            ahead = den > np.float32(1e-4)
                            inv = np.float32(1.0) / (den if ahead else np.float32(1.0))
                            u = (ux * dx + nu) * inv
                            v = (vx * dx + nv) * inv
                            r3 = u * u + v * v
                            r3 = r3 if ahead else np.float32(1e8)
                            r2 = np.float32(2.0) * (dx * dx + dy2)
                            plane = r3 <= r2
                            rho = r3 if plane else r2
                            z = zc * inv if plane else zc
                            m = NDC32 * (iz0 - (den * izc if plane else izc))
                            alpha = op * _exp_neg(np.float32(0.5) * rho)
                            alpha = alpha if alpha < np.float32(ALPHA_MAX) else np.float32(ALPHA_MAX)
                            t = s[base + o_t + x]
                            on = (alpha >= np.float32(ALPHA_MIN)) & (t >= np.float32(T_STOP))
                            alpha = alpha if on else np.float32(0.0)
                            w = alpha * t
                            tn = t - w
                            cross = (t > np.float32(0.5)) & (tn <= np.float32(0.5))
                            a_sum = np.float32(1.0) - t
                            b1, b2 = s[base + o_b1 + x], s[base + o_b2 + x]
                            s[base + o_t + x] = tn
                            s[base + o_z + x] += w * z
                            s[base + o_d + x] += w * (m * m * a_sum + b2 - np.float32(2.0) * m * b1)
                            s[base + o_b1 + x] = b1 + w * m
                            s[base + o_b2 + x] = b2 + w * m * m
                            s[base + o_m + x] = z if cross else s[base + o_m + x]
                            s[base + o_w + x] = w
                            t_left += tn
                        for c in range(c_n):
                            f = features[g, c]
                            slot = base + o_f + c * n8
                            for x in range(n8):
                                s[slot + x] += s[base + o_w + x] * f
                        live[half * TILE + r] = t_left >= np.float32(T_STOP)
                if (k - begin) % 8 == 0:
                    any_live = False
                    for r in range(2 * TILE):
                        any_live = any_live | live[r]
                    if not any_live:
                        break
            used[tile] = k
            for half in range(2):
                x0 = px + half * LANES
                n_x = min(LANES, width - x0)
                for r in range(n_rows):
                    base = np.uint64(half) * half_size + np.uint64(r) * row_size
                    y = py + r
                    for c in range(channels):
                        for x in range(n_x):
                            out[c, y, x0 + x] = s[base + o_f + np.uint64(c * LANES + x)]
                    for x in range(n_x):
                        xx = np.uint64(x)
                        out[channels, y, x0 + x] = s[base + o_z + xx]
                        out[channels + 1, y, x0 + x] = s[base + o_d + xx]
                        out[channels + 2, y, x0 + x] = s[base + o_b1 + xx]
                        out[channels + 3, y, x0 + x] = s[base + o_b2 + xx]
                        out[channels + 4, y, x0 + x] = np.float32(1.0) - s[base + o_t + xx]
                        out[channels + 5, y, x0 + x] = s[base + o_m + xx]

    return forward


@lru_cache(maxsize=16)
def backward_kernel(channels: int) -> Any:
    """Compiled backward: fills one gradient slot per (tile, surfel) pair, see the module's notes."""
    c_n = np.uint64(channels)
    n8 = np.uint64(LANES)
    # per row: T, rest, A, B1, B2, lane temporaries, gradient planes (features, depth, distortion, alpha); the accumulators are an array of
    # their own, so that within either every distance is a constant and one alias check per loop remains
    o_t, o_r, o_a, o_b1, o_b2 = (np.uint64(i * LANES) for i in range(5))
    n_tmp = 10
    i_w, i_al, i_u, i_v, i_inv, i_pl, i_z, i_m, i_g, i_e = (np.uint64((5 + i) * LANES) for i in range(n_tmp))
    o_g = np.uint64((5 + n_tmp) * LANES)
    o_gz = o_g + c_n * n8
    o_gd = o_gz + n8
    o_ga = o_gd + n8
    row_size = np.uint64((5 + n_tmp + channels + GRADS) * LANES)
    half_size = np.uint64(TILE) * row_size
    total = 2 * int(half_size)
    a_ux, a_uy, a_vx, a_vy, a_wx, a_wy, a_zc, a_o, a_w = (np.uint64(i * LANES) for i in range(2, SLOT))
    acc_f = np.uint64(SLOT * LANES)
    acc_size = (SLOT + channels) * LANES

    @njit(**JIT)
    def backward(order, lo, hi, starts, ids, slots, geo, box, opacity, features, width, height, tiles_x, out, used, grad, result):  # type: ignore[no-untyped-def]
        s = np.empty(total, np.float32)
        a = np.zeros(acc_size, np.float32)
        live = np.empty(2 * TILE, np.bool_)
        for at in range(lo, hi):
            tile = order[at]
            ty = tile // tiles_x
            tx = tile - ty * tiles_x
            px, py = tx * TILE, ty * TILE
            n_rows = min(TILE, height - py)
            s[:] = np.float32(0.0)
            for half in range(2):
                x0 = px + half * LANES
                n_x = min(LANES, width - x0)
                for r in range(n_rows):
                    base = np.uint64(half) * half_size + np.uint64(r) * row_size
                    y = py + r
                    live[half * TILE + r] = n_x > 0
                    for x in range(n_x):
                        xx = np.uint64(x)
                        rest = np.float32(0.0)
                        for c in range(channels):
                            gc = grad[c, y, x0 + x]
                            s[base + o_g + np.uint64(c * LANES) + xx] = gc
                            rest += gc * out[c, y, x0 + x]
                        gz, gd, ga = grad[channels, y, x0 + x], grad[channels + 1, y, x0 + x], grad[channels + 2, y, x0 + x]
                        a_tot = out[channels + 4, y, x0 + x]
                        rest += gz * out[channels, y, x0 + x] + np.float32(2.0) * gd * out[channels + 1, y, x0 + x] + ga * a_tot
                        s[base + o_gz + xx] = gz
                        s[base + o_gd + xx] = gd
                        s[base + o_ga + xx] = ga
                        s[base + o_t + xx] = np.float32(1.0)
                        s[base + o_r + xx] = rest
                        s[base + o_a + xx] = a_tot
                        s[base + o_b1 + xx] = out[channels + 2, y, x0 + x]
                        s[base + o_b2 + xx] = out[channels + 3, y, x0 + x]
            begin, end = starts[tile], used[tile]
            iz0 = np.float32(0.0)
            if end > begin:
                iz0 = np.float32(1.0) / geo[ids[begin], 8]
            for k in range(begin, end):
                g = np.uint64(ids[k])
                slot = slots[k]
                xc, yc = geo[g, 0], geo[g, 1]
                ux, uy, vx, vy = geo[g, 2], geo[g, 3], geo[g, 4], geo[g, 5]
                wx, wy, zc = geo[g, 6], geo[g, 7], geo[g, 8]
                op = opacity[g]
                izc = np.float32(1.0) / zc
                r0, r1 = max(box[g, 2] - py, 0), min(box[g, 3] - py, n_rows - 1)
                touched = False
                for half in range(2):
                    x0 = px + half * LANES
                    if box[g, 1] < x0 or box[g, 0] > x0 + LANES - 1:
                        continue
                    fx = np.float32(x0) + np.float32(0.5) - xc
                    for r in range(r0, r1 + 1):
                        if not live[half * TILE + r]:
                            continue
                        base = np.uint64(half) * half_size + np.uint64(r) * row_size
                        dy = np.float32(py + r) + np.float32(0.5) - yc
                        nu, nv, nw = uy * dy, vy * dy, np.float32(1.0) + wy * dy
                        dy2 = dy * dy
                        t_left = np.float32(0.0)
                        w_sum = np.float32(0.0)
                        for x in range(n8):
                            dx = fx + np.float32(x)
                            den = nw + wx * dx
                            ahead = den > np.float32(1e-4)
                            inv = np.float32(1.0) / (den if ahead else np.float32(1.0))
                            u = (ux * dx + nu) * inv
                            v = (vx * dx + nv) * inv
                            r3 = u * u + v * v
                            r3 = r3 if ahead else np.float32(1e8)
                            r2 = np.float32(2.0) * (dx * dx + dy2)
                            plane = r3 <= r2
                            rho = r3 if plane else r2
                            z = zc * inv if plane else zc
                            m = NDC32 * (iz0 - (den * izc if plane else izc))
                            e = _exp_neg(np.float32(0.5) * rho)
                            raw = op * e
                            alpha = raw if raw < np.float32(ALPHA_MAX) else np.float32(ALPHA_MAX)
                            t = s[base + o_t + x]
                            on = (alpha >= np.float32(ALPHA_MIN)) & (t >= np.float32(T_STOP))
                            alpha = alpha if on else np.float32(0.0)
                            w = alpha * t
                            # gradient of α reaches ρ and o only where α is neither clamped nor skipped
                            e = e if on & (raw < np.float32(ALPHA_MAX)) else np.float32(0.0)
                            s[base + i_w + x] = w
                            s[base + i_al + x] = alpha
                            s[base + i_u + x] = u
                            s[base + i_v + x] = v
                            s[base + i_inv + x] = inv
                            s[base + i_pl + x] = np.float32(1.0) if plane else np.float32(0.0)
                            s[base + i_z + x] = z
                            s[base + i_m + x] = m
                            s[base + i_e + x] = e
                            mom = m * m * s[base + o_a + x] + s[base + o_b2 + x] - np.float32(2.0) * m * s[base + o_b1 + x]
                            s[base + i_g + x] = s[base + o_ga + x] + s[base + o_gz + x] * z + s[base + o_gd + x] * mom
                            t_left += t - w
                            w_sum += w
                        if not w_sum > np.float32(0.0):
                            continue
                        touched = True
                        live[half * TILE + r] = t_left >= np.float32(T_STOP)
                        for c in range(c_n):
                            f = features[g, c]
                            ga_c = base + o_g + c * n8
                            for x in range(n8):
                                s[base + i_g + x] += s[ga_c + x] * f
                        for c in range(c_n):
                            ga_c = base + o_g + c * n8
                            ac_c = acc_f + c * n8
                            for x in range(n8):
                                a[ac_c + x] += s[ga_c + x] * s[base + i_w + x]
                        for x in range(n8):
                            dx = fx + np.float32(x)
                            w, alpha, inv, plane = s[base + i_w + x], s[base + i_al + x], s[base + i_inv + x], s[base + i_pl + x]
                            u, v, z, m, e = s[base + i_u + x], s[base + i_v + x], s[base + i_z + x], s[base + i_m + x], s[base + i_e + x]
                            t = s[base + o_t + x]
                            gw = s[base + i_g + x]
                            rest = s[base + o_r + x] - w * gw
                            s[base + o_r + x] = rest
                            s[base + o_t + x] = t - w
                            g_alpha = t * gw - rest / (np.float32(1.0) - alpha)
                            g_rho = np.float32(-0.5) * g_alpha * op * e
                            g_uv = np.float32(2.0) * g_rho * plane
                            gu, gv = g_uv * u, g_uv * v
                            g_lp = np.float32(4.0) * g_rho * (np.float32(1.0) - plane)
                            gz = w * s[base + o_gz + x]
                            gm = np.float32(2.0) * w * s[base + o_gd + x] * (m * s[base + o_a + x] - s[base + o_b1 + x])
                            den = nw + wx * dx
                            iz = izc * (den * plane + (np.float32(1.0) - plane))
                            g_den = -inv * (gu * u + gv * v + plane * gz * z) - plane * gm * NDC32 * izc
                            gui, gvi = gu * inv, gv * inv
                            # the temporaries of the first pass are free now
                            s[base + i_g + x] = gui * ux + gvi * vx + g_den * wx + g_lp * dx
                            s[base + i_al + x] = gui * uy + gvi * vy + g_den * wy + g_lp * dy
                            s[base + i_u + x] = gui
                            s[base + i_v + x] = gvi
                            s[base + i_m + x] = g_den
                            s[base + i_z + x] = gz * (z * izc) + gm * NDC32 * iz * izc
                            s[base + i_e + x] = g_alpha * e
                        for x in range(n8):
                            dx = fx + np.float32(x)
                            a[x] -= s[base + i_g + x]
                            a[n8 + x] -= s[base + i_al + x]
                            a[a_ux + x] += s[base + i_u + x] * dx
                            a[a_uy + x] += s[base + i_u + x] * dy
                        for x in range(n8):
                            dx = fx + np.float32(x)
                            a[a_vx + x] += s[base + i_v + x] * dx
                            a[a_vy + x] += s[base + i_v + x] * dy
                            a[a_wx + x] += s[base + i_m + x] * dx
                            a[a_wy + x] += s[base + i_m + x] * dy
                        for x in range(n8):
                            a[a_zc + x] += s[base + i_z + x]
                            a[a_o + x] += s[base + i_e + x]
                            a[a_w + x] += s[base + i_w + x]
                if touched:
                    for j in range(SLOT + channels):
                        v0 = np.float32(0.0)
                        at_j = np.uint64(j * LANES)
                        for x in range(n8):
                            v0 += a[at_j + x]
                            a[at_j + x] = np.float32(0.0)
                        result[slot, j] = v0
                else:
                    for j in range(SLOT + channels):
                        result[slot, j] = np.float32(0.0)
            for k in range(end, starts[tile + 1]):
                for j in range(SLOT + channels):
                    result[slots[k], j] = np.float32(0.0)

    return backward


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
