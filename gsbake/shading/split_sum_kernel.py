"""Numba kernels of split-sum shading on the CPU in float32; the reference implementation is `split_sum._reference`.

Pixels are independent: the forward kernel writes the colour, the backward kernel recomputes the pixel and writes the gradients of its
inputs. Gradients of the light table are summed over pixels, in a fixed number of chunks with one table each, so the result does not depend
on the number of threads.

All literals are float32: a float64 constant would widen the whole expression.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

from gsbake.kernels.declaration import kernel
from gsbake.shading.octahedral import MIN_L1_NORM

#: No fast-math flags: Numba optimises the body of a parallel loop once for the process that compiles it and once more for the copy on the
#: disk, so with them a first run would round differently from all later ones. Small functions are inlined by LLVM (`forceinline`): inlined
#: by Numba, before it infers types and analyses parallel loops, they make the compilation of a long kernel eight times as long.
_FLAGS: Any = {"fastmath": False, "error_model": "numpy", "cache": True, "nogil": True}

#: Pixel chunks with separate gradient tables; fixed, for results that do not depend on the number of threads.
CHUNKS = 8

_0 = np.float32(0.0)
_1 = np.float32(1.0)
_2 = np.float32(2.0)
_HALF = np.float32(0.5)
_U1 = np.uint64(1)
_MIN_L1_NORM = np.float32(MIN_L1_NORM)

#: Squared length below which a normal gets no gradient.
MIN_SQUARED_LENGTH = np.float32(1e-4)

#: Width m of the smooth clamp of c = n·v: (c + √(c² + 4 m²)) / 2.
COSINE_CLAMP_WIDTH = np.float32(0.01)
_CLAMP_TERM = np.float32(4.0) * COSINE_CLAMP_WIDTH * COSINE_CLAMP_WIDTH


@njit(forceinline=True, **_FLAGS)
def _sign(x: Any) -> Any:
    return _1 if x > _0 else (-_1 if x < _0 else _0)


@njit(forceinline=True, **_FLAGS)
def _encode(x: Any, y: Any, z: Any) -> Any:
    """Octahedral coordinates u, v in [−1, 1] of a direction."""
    inverse = _1 / max(abs(x) + abs(y) + abs(z), _MIN_L1_NORM)
    p = x * inverse
    q = y * inverse
    if z < _0:
        return (_1 - abs(q)) * (_1 if p >= _0 else -_1), (_1 - abs(p)) * (_1 if q >= _0 else -_1)
    return p, q


@njit(forceinline=True, **_FLAGS)
def _encode_backward(x: Any, y: Any, z: Any, gu: Any, gv: Any) -> Any:
    """Gradient of `_encode` with respect to x, y, z."""
    inverse = _1 / max(abs(x) + abs(y) + abs(z), _MIN_L1_NORM)
    gp = gu
    gq = gv
    if z < _0:
        gp = -gv * (_1 if y >= _0 else -_1) * _sign(x)
        gq = -gu * (_1 if x >= _0 else -_1) * _sign(y)
    norm = -inverse * inverse * (gp * x + gq * y)
    return gp * inverse + norm * _sign(x), gq * inverse + norm * _sign(y), norm * _sign(z)


@njit(forceinline=True, **_FLAGS)
def _cell(x: Any, last: Any) -> Any:
    """Index of the cell that contains x, clamped to 0…last; 0 for NaN. Unsigned, so that Numba omits the wrap-around test."""
    return np.uint64(np.int64(min(x, np.float32(last)))) if x >= _0 else np.uint64(0)


@njit(forceinline=True, **_FLAGS)
def _taps(u: Any, v: Any, size: Any, start: Any) -> Any:
    """Index of the first texel, row stride and fractions of the bilinear interpolation in one level."""
    half = _HALF * np.float32(size)
    x = (u + _1) * half + _HALF
    y = (v + _1) * half + _HALF
    col = _cell(x, size)
    row = _cell(y, size)
    stride = np.uint64(size + 2)
    return np.uint64(start) + row * stride + col, stride, x - np.float32(np.int64(col)), y - np.float32(np.int64(row))


@njit(forceinline=True, **_FLAGS)
def _bilinear(table: Any, base: Any, stride: Any, fx: Any, fy: Any, c: Any) -> Any:
    top = table[base, c] + fx * (table[base + _U1, c] - table[base, c])
    bottom = table[base + stride, c] + fx * (table[base + stride + _U1, c] - table[base + stride, c])
    return top + fy * (bottom - top)


@njit(forceinline=True, **_FLAGS)
def _bilinear_backward(table: Any, out: Any, base: Any, stride: Any, fx: Any, fy: Any, c: Any, g: Any) -> Any:
    """Add the gradient g to the four texels of `out`; returns the gradients of fx and fy."""
    a = table[base, c]
    b = table[base + _U1, c]
    d = table[base + stride, c]
    e = table[base + stride + _U1, c]
    gy = g * fy
    gx = g - gy
    out[base, c] += gx * (_1 - fx)
    out[base + _U1, c] += gx * fx
    out[base + stride, c] += gy * (_1 - fx)
    out[base + stride + _U1, c] += gy * fx
    return gx * (b - a) + gy * (e - d), g * ((d - a) + fx * ((e - d) - (b - a)))


@njit(forceinline=True, **_FLAGS)
def _roughness_level(roughness: Any, knots: Any) -> Any:
    """Lower roughness level and interpolation weight of the next one, both clamped."""
    last = knots.shape[0] - 2
    k = 0
    while k < last and roughness >= knots[k + 1]:
        k += 1
    t = (roughness - knots[k]) / (knots[k + 1] - knots[k])
    return k, min(max(t, _0), _1)


@njit(forceinline=True, **_FLAGS)
def _mirror_weight(roughness: Any) -> Any:
    """Share of the lobe that follows the mirror direction, as in `split_sum`."""
    alpha = min(max(roughness, _0), _1)
    alpha *= alpha
    smoothness = _1 - alpha
    return smoothness * (math.sqrt(smoothness) + alpha)


@njit(forceinline=True, **_FLAGS)
def _geometry(normal: Any, view: Any, i: Any) -> Any:
    """Inverse length of the normal, unit normal, and its cosine with the view direction."""
    x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
    inverse = _1 / math.sqrt(max(x * x + y * y + z * z, MIN_SQUARED_LENGTH))
    x *= inverse
    y *= inverse
    z *= inverse
    return inverse, x, y, z, x * view[i, 0] + y * view[i, 1] + z * view[i, 2]


@njit(forceinline=True, **_FLAGS)
def _table_cell(root: Any, roughness: Any, lut: Any) -> Any:
    """Cell and interpolation weights of the split-sum table at √(n·v) and roughness."""
    x = root * np.float32(lut.shape[1] - 1)
    y = min(max(roughness, _0), _1) * np.float32(lut.shape[0] - 1)
    col = _cell(x, lut.shape[1] - 2)
    row = _cell(y, lut.shape[0] - 2)
    return row, col, x - np.float32(np.int64(col)), y - np.float32(np.int64(row))


@njit(forceinline=True, **_FLAGS)
def _table_value(lut: Any, row: Any, col: Any, fx: Any, fy: Any, k: Any) -> Any:
    """Column k of the split-sum table between its nodes."""
    top = lut[row, col, k] + fx * (lut[row, col + _U1, k] - lut[row, col, k])
    bottom = lut[row + _U1, col, k] + fx * (lut[row + _U1, col + _U1, k] - lut[row + _U1, col, k])
    return top + fy * (bottom - top)


@njit(forceinline=True, **_FLAGS)
def _table_slopes(lut: Any, row: Any, col: Any, fx: Any, fy: Any, k: Any) -> Any:
    """Derivatives of `_table_value` in fx and fy."""
    a, b = lut[row, col, k], lut[row, col + _U1, k]
    d, e = lut[row + _U1, col, k], lut[row + _U1, col + _U1, k]
    return (b - a) + fy * ((e - d) - (b - a)), (d - a) + fx * ((e - b) - (d - a))


@kernel(
    "f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[:, ::1], f4[::1], i8[::1], i8[::1], "
    "Array(f4, 3, 'C', readonly=True), f4[:, ::1]",
    parallel=True, **_FLAGS,
)
def forward(
    normal: Any, view: Any, albedo: Any, roughness: Any, metallic: Any, visibility_d: Any, visibility_s: Any,
    table: Any, knots: Any, sizes: Any, offsets: Any, lut: Any, out: Any,
) -> None:  # fmt: skip
    """Colours `out` (n, 3) of n pixels; `visibility_d`, `visibility_s` (n,) are factors of the diffuse and specular terms."""
    n = normal.shape[0]
    for chunk in prange(CHUNKS):
        for pixel in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            i = np.uint64(pixel)
            inverse, nx, ny, nz, c = _geometry(normal, view, i)
            root = math.sqrt(_HALF * (c + math.sqrt(c * c + _CLAMP_TERM)))
            row, col, fx, fy = _table_cell(root, roughness[i], lut)
            scale = _table_value(lut, row, col, fx, fy, 0)
            bias = _table_value(lut, row, col, fx, fy, 1)
            share = _table_value(lut, row, col, fx, fy, 2)
            rough = _table_value(lut, row, col, fx, fy, 3)
            mirror = _table_value(lut, row, col, fx, fy, 4)
            dielectric = _table_value(lut, row, col, fx, fy, 5)
            transmitted = _1 - dielectric

            coeff = _1 + mirror * (_2 * c - _1)
            u, v = _encode(coeff * nx - mirror * view[i, 0], coeff * ny - mirror * view[i, 1], coeff * nz - mirror * view[i, 2])
            level, t = _roughness_level(rough, knots)
            base0, stride0, fx0, fy0 = _taps(u, v, sizes[level], offsets[level])
            base1, stride1, fx1, fy1 = _taps(u, v, sizes[level + 1], offsets[level + 1])
            u, v = _encode(nx, ny, nz)
            last = sizes.shape[0] - 1
            base2, stride2, fx2, fy2 = _taps(u, v, sizes[last], offsets[last])
            metal = metallic[i]
            for ch in range(3):
                lower = _bilinear(table, base0, stride0, fx0, fy0, ch)
                upper = _bilinear(table, base1, stride1, fx1, fy1, ch)
                irradiance = _bilinear(table, base2, stride2, fx2, fy2, ch)
                reflectance = metal * (albedo[i, ch] * scale + bias) + (_1 - metal) * dielectric
                narrow = lower + t * (upper - lower)
                light = narrow + share * (irradiance - narrow)
                diffuse = (_1 - metal) * albedo[i, ch] * transmitted * irradiance
                out[i, ch] = visibility_d[i] * diffuse + visibility_s[i] * light * reflectance


@njit(parallel=True, **_FLAGS)
def backward(
    normal: Any, view: Any, albedo: Any, roughness: Any, metallic: Any, visibility_d: Any, visibility_s: Any,
    table: Any, knots: Any, sizes: Any, offsets: Any, lut: Any, grad: Any,
    g_normal: Any, g_view: Any, g_albedo: Any, g_roughness: Any, g_metallic: Any, g_visibility_d: Any, g_visibility_s: Any, g_table: Any,
) -> None:  # fmt: skip
    """Gradients of all inputs from `grad` (n, 3); `g_table` (CHUNKS, texels, 3) is zero on entry and summed by the caller."""
    n = normal.shape[0]
    for chunk in prange(CHUNKS):
        table_grad = g_table[chunk]
        for pixel in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            i = np.uint64(pixel)
            inverse, nx, ny, nz, c = _geometry(normal, view, i)
            soft_root = math.sqrt(c * c + _CLAMP_TERM)
            root = math.sqrt(_HALF * (c + soft_root))
            row, col, fx, fy = _table_cell(root, roughness[i], lut)
            scale = _table_value(lut, row, col, fx, fy, 0)
            bias = _table_value(lut, row, col, fx, fy, 1)
            share = _table_value(lut, row, col, fx, fy, 2)
            rough = _table_value(lut, row, col, fx, fy, 3)
            mirror = _table_value(lut, row, col, fx, fy, 4)
            dielectric = _table_value(lut, row, col, fx, fy, 5)
            transmitted = _1 - dielectric

            coeff = _1 + mirror * (_2 * c - _1)
            rx = coeff * nx - mirror * view[i, 0]
            ry = coeff * ny - mirror * view[i, 1]
            rz = coeff * nz - mirror * view[i, 2]
            u, v = _encode(rx, ry, rz)
            level, t = _roughness_level(rough, knots)
            base0, stride0, fx0, fy0 = _taps(u, v, sizes[level], offsets[level])
            base1, stride1, fx1, fy1 = _taps(u, v, sizes[level + 1], offsets[level + 1])
            u, v = _encode(nx, ny, nz)
            last = sizes.shape[0] - 1
            base2, stride2, fx2, fy2 = _taps(u, v, sizes[last], offsets[last])
            metal = metallic[i]

            g_u = g_v = g_un = g_vn = g_t = g_scale = g_bias = g_share = g_dielectric = g_metal = g_vd = g_vs = _0
            half0 = _HALF * np.float32(sizes[level])
            half1 = _HALF * np.float32(sizes[level + 1])
            half2 = _HALF * np.float32(sizes[last])
            for ch in range(3):
                g = grad[i, ch]
                base = albedo[i, ch]
                lower = _bilinear(table, base0, stride0, fx0, fy0, ch)
                upper = _bilinear(table, base1, stride1, fx1, fy1, ch)
                irradiance = _bilinear(table, base2, stride2, fx2, fy2, ch)
                metallic_reflectance = base * scale + bias
                narrow = lower + t * (upper - lower)
                light = narrow + share * (irradiance - narrow)
                reflectance = metal * metallic_reflectance + (_1 - metal) * dielectric
                diffuse = g * (_1 - metal) * base * irradiance  # gradient of visibility and transmittance together
                g_d = g * visibility_d[i] * transmitted
                g_s = g * visibility_s[i]
                g_vd += diffuse * transmitted
                g_vs += g * light * reflectance
                g_albedo[i, ch] = g_d * (_1 - metal) * irradiance + g_s * light * scale * metal
                g_metal += g_s * light * (metallic_reflectance - dielectric) - g_d * base * irradiance
                g_scale += g_s * light * metal * base
                g_bias += g_s * light * metal
                g_dielectric += g_s * light * (_1 - metal) - visibility_d[i] * diffuse
                g_light = g_s * reflectance
                g_share += g_light * (irradiance - narrow)
                g_narrow = g_light * (_1 - share)
                g_t += g_narrow * (upper - lower)
                du, dv = _bilinear_backward(table, table_grad, base0, stride0, fx0, fy0, ch, g_narrow * (_1 - t))
                g_u += du * half0
                g_v += dv * half0
                du, dv = _bilinear_backward(table, table_grad, base1, stride1, fx1, fy1, ch, g_narrow * t)
                g_u += du * half1
                g_v += dv * half1
                g_irradiance = g_d * (_1 - metal) * base + g_light * share
                du, dv = _bilinear_backward(table, table_grad, base2, stride2, fx2, fy2, ch, g_irradiance)
                g_un += du * half2
                g_vn += dv * half2
            g_metallic[i] = g_metal
            g_visibility_d[i] = g_vd
            g_visibility_s[i] = g_vs

            # Gradients of the lobe's direction (1 + m (2c − 1)) n − m v and the cosine c = n·v, through the normalisation of the normal.
            gx, gy, gz = _encode_backward(rx, ry, rz, g_u, g_v)
            g_along = gx * nx + gy * ny + gz * nz
            g_mirror = (_2 * c - _1) * g_along - (gx * view[i, 0] + gy * view[i, 1] + gz * view[i, 2])

            # Split-sum table: derivatives along √(n·v) and roughness.
            g_rough = g_t / (knots[level + 1] - knots[level])
            d_root = d_row = _0
            for k, g in ((0, g_scale), (1, g_bias), (2, g_share), (3, g_rough), (4, g_mirror), (5, g_dielectric)):
                along_root, along_row = _table_slopes(lut, row, col, fx, fy, k)
                d_root += g * along_root
                d_row += g * along_row
            g_c = d_root * np.float32(lut.shape[1] - 1) * _HALF / root * _HALF * (_1 + c / soft_root) + _2 * mirror * g_along
            g_roughness[i] = d_row * np.float32(lut.shape[0] - 1) if _0 <= roughness[i] <= _1 else _0
            hx, hy, hz = _encode_backward(nx, ny, nz, g_un, g_vn)
            hx += coeff * gx + g_c * view[i, 0]
            hy += coeff * gy + g_c * view[i, 1]
            hz += coeff * gz + g_c * view[i, 2]
            g_view[i, 0] = g_c * nx - mirror * gx
            g_view[i, 1] = g_c * ny - mirror * gy
            g_view[i, 2] = g_c * nz - mirror * gz
            radial = hx * nx + hy * ny + hz * nz
            keep = inverse if inverse * inverse * MIN_SQUARED_LENGTH < _1 else _0
            g_normal[i, 0] = keep * (hx - radial * nx)
            g_normal[i, 1] = keep * (hy - radial * ny)
            g_normal[i, 2] = keep * (hz - radial * nz)
