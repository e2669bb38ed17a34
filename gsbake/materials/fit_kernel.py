"""Numba kernels of one step of the material fit on the CPU in float32; `fit_reference` is the same in PyTorch.

`shade_and_differentiate` reads the texels of each pixel, shades it (split sum, light transport, reflections of the object), compares it
with the photo, and writes the gradient with respect to the pixel's material; pixels are independent. Gradients of the light's table are
summed in a fixed number of chunks. `gather_gradient` adds the pixels' gradients up per texel, from a list of each texel's pixels. Every sum
has a fixed order: results do not depend on threads.

All literals are float32: a float64 constant would widen the whole expression.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numba import njit, prange

from gsbake.imaging.srgb import encode
from gsbake.kernels.declaration import argument_types, kernel
from gsbake.shading.reflection_kernel import reflected_radiance, specular_visibility
from gsbake.shading.split_sum_kernel import (
    _CLAMP_TERM,
    _FLAGS,
    CHUNKS,
    MIN_SQUARED_LENGTH,
    _bilinear,
    _bilinear_backward,
    _cell,
    _encode,
    _encode_backward,
    _geometry,
    _roughness_level,
    _table_cell,
    _table_slopes,
    _table_value,
    _taps,
)

_0, _1, _2, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
#: The sRGB curve at the squares of 0, 1/1024 … 1: over the square root it is so smooth that lines between are off by 4e-6 at most.
_CURVE = encode(np.square(np.arange(1026) / 1024)).astype(np.float32)
_CURVE_STEPS, _CURVE_HALF = np.float32(1024), np.float32(512)

#: Columns of a texel's parameters: base colour (3), roughness, metallic, normal offset (3).
PARAMETERS = 8
#: Columns of a pixel's shading parameters: diffuse albedo (3), base colour times metallic (3), roughness, normal offset (3), metallic.
SHADING = 11
#: Light transport at a place: visibility (0..1) of the present light and, for specular reflection, of uniform light (ambient occlusion);
#: indirect irradiance / π; emission.
LOCAL = np.dtype([("visibility", "f4"), ("occlusion", "f4"), ("indirect", "f4", 3), ("emission", "f4", 3)], align=True)
#: That of a texel, and for reflections of it diffuse radiosity / π, base colour times metallic, roughness, unit normal, metallic.
TRANSPORT = np.dtype(
    [*((name, LOCAL[name]) for name in LOCAL.names or ()), ("diffuse", "f4", 3), ("metal_colour", "f4", 3), ("roughness", "f4"),
     ("normal", "f4", 3), ("metallic", "f4")],
    align=True,
)  # fmt: skip
_LOCAL, _TRANSPORT = (numba.types.Array(numba.from_dtype(record), 1, "C") for record in (LOCAL, TRANSPORT))
_TABLES = "f4[:, ::1], f4[::1], i8[::1], i8[::1], Array(f4, 3, 'C', readonly=True)"


@njit(forceinline=True, **_FLAGS)
def srgb_and_slope(linear: Any) -> Any:
    """sRGB of a linear value in [0, 1], and its derivative."""
    root = math.sqrt(linear)
    at = root * _CURVE_STEPS
    k = _cell(at, 1024)
    rise = _CURVE[k + np.uint64(1)] - _CURVE[k]
    return _CURVE[k] + (at - np.float32(k)) * rise, rise * _CURVE_HALF / max(root, _HALF / _CURVE_STEPS)


@kernel(
    (*argument_types("i4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], i4[::1], f4[:, ::1]"), _TRANSPORT,
     *argument_types(f"{_TABLES}, f4, f4, f4, f4[:, ::1], f4[:, :, ::1], f8[:, ::1]")),
    parallel=True, **_FLAGS,
)  # fmt: skip
def shade_and_differentiate(
    texel: Any, bilinear: Any, normal: Any, view: Any, colour: Any, weight: Any, reflected: Any,
    values: Any, transport: Any, table: Any, knots: Any, sizes: Any, offsets: Any, lut: Any,
    residual_weight: Any, robust: Any, factor: Any, gradient: Any, g_table: Any, sums: Any,
) -> None:  # fmt: skip
    """Loss and gradients of n pixels of one photo.

    `texel`, `bilinear` (n, 4) taps; `normal` (n, 3) of the mesh; `view`, sRGB `colour` (n, 3); `weight` (n,); `reflected` (n,) texel that
    the reflected ray hits, −1: none, or empty: not traced; `values` (texels, PARAMETERS); `transport` (texels,) of `TRANSPORT`; `table` …
    `lut` as in `split_sum_kernel`. `factor` scales the gradients. Written: `gradient` (n, SHADING) of the pixels' interpolated parameters;
    added: `g_table` (CHUNKS, rows, 3); `sums` (CHUNKS, 3) loss, weighted mean squared error and weight.
    """
    for chunk in prange(CHUNKS):
        _shade_chunk(
            np.int64(chunk), texel, bilinear, normal, view, colour, weight, reflected, values, transport, table, knots, sizes, offsets, lut,
            residual_weight, robust, factor, gradient, g_table[chunk], sums[chunk],
        )  # fmt: skip


@njit(**_FLAGS)
def _shade_chunk(
    chunk: Any, texel: Any, bilinear: Any, normal: Any, view: Any, colour: Any, weight: Any, reflected: Any,
    values: Any, transport: Any, table: Any, knots: Any, sizes: Any, offsets: Any, lut: Any,
    residual_weight: Any, robust: Any, factor: Any, gradient: Any, table_grad: Any, sums: Any,
) -> None:  # fmt: skip
    """The same for the pixels of one chunk. A function of its own, as Numba analyses parallel loops longer."""
    n = texel.shape[0]
    last = sizes.shape[0] - 1
    half2 = _HALF * np.float32(sizes[last])
    third = factor * residual_weight / np.float32(3)  # errors are means over the channels
    loss_sum = 0.0
    square_sum = 0.0
    weight_sum = 0.0
    shading = np.empty(SHADING, np.float32)
    indirect, emission = np.empty(3, np.float32), np.empty(3, np.float32)
    bounced = np.zeros(3, np.float32)
    for pixel in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
        i = np.uint64(pixel)
        for c in range(SHADING):
            shading[c] = _0
        visible = occlusion = _0
        indirect[:] = _0
        emission[:] = _0
        for k in range(4):
            w = bilinear[i, k]
            t = np.uint64(texel[i, k])
            if w > _0:
                w_metal = w * values[t, 4]
                for c in range(3):
                    shading[c] += (w - w_metal) * values[t, c]
                    shading[3 + c] += w_metal * values[t, c]
                    shading[7 + c] += w * values[t, 5 + c]
                shading[6] += w * values[t, 3]
                shading[10] += w_metal
                at = transport[t]
                visible += w * at.visibility
                occlusion += w * at.occlusion
                for c in range(3):
                    indirect[c] += w * at.indirect[c]
                    emission[c] += w * at.emission[c]
        rough = shading[6]

        # Geometry.
        nx = normal[i, 0] + shading[7]
        ny = normal[i, 1] + shading[8]
        nz = normal[i, 2] + shading[9]
        inverse = _1 / math.sqrt(max(nx * nx + ny * ny + nz * nz, MIN_SQUARED_LENGTH))
        nx *= inverse
        ny *= inverse
        nz *= inverse
        vx, vy, vz = view[i, 0], view[i, 1], view[i, 2]
        c = nx * vx + ny * vy + nz * vz
        soft_root = math.sqrt(c * c + _CLAMP_TERM)
        soft = _HALF * (c + soft_root)
        root = math.sqrt(soft)
        row, col, fx, fy = _table_cell(root, rough, lut)
        scale = _table_value(lut, row, col, fx, fy, 0)
        bias = _table_value(lut, row, col, fx, fy, 1)
        share = _table_value(lut, row, col, fx, fy, 2)
        lobe_rough = _table_value(lut, row, col, fx, fy, 3)
        mirror = _table_value(lut, row, col, fx, fy, 4)
        dielectric = _table_value(lut, row, col, fx, fy, 5)
        transmitted = _1 - dielectric
        metal = shading[10]
        coeff = _1 + mirror * (_2 * c - _1)
        rx = coeff * nx - mirror * vx
        ry = coeff * ny - mirror * vy
        rz = coeff * nz - mirror * vz
        u, v = _encode(rx, ry, rz)
        level, t_level = _roughness_level(lobe_rough, knots)
        base0, stride0, fx0, fy0 = _taps(u, v, sizes[level], offsets[level])
        base1, stride1, fx1, fy1 = _taps(u, v, sizes[level + 1], offsets[level + 1])
        u, v = _encode(nx, ny, nz)
        base2, stride2, fx2, fy2 = _taps(u, v, sizes[last], offsets[last])
        visible_s, blocked, incident, hit = specular_visibility(soft, rough, occlusion, reflected, i)
        bounced[:] = _0
        if incident > _0:
            two = _2 * c
            x, y, z = two * nx - vx, two * ny - vy, two * nz - vz
            reflected_radiance(transport, hit, x, y, z, table, knots, sizes, offsets, lut, bounced)

        # Shade, compare, differentiate; one channel at a time.
        w = weight[i]
        g_u = g_v = g_un = g_vn = g_t = g_scale = g_bias = g_share = g_metal = g_dielectric = _0
        half0 = _HALF * np.float32(sizes[level])
        half1 = _HALF * np.float32(sizes[level + 1])
        squares = _0
        loss = _0
        for ch in range(3):
            albedo = shading[ch]
            metal_colour = shading[3 + ch]
            lower = _bilinear(table, base0, stride0, fx0, fy0, ch)
            upper = _bilinear(table, base1, stride1, fx1, fy1, ch)
            irradiance = _bilinear(table, base2, stride2, fx2, fy2, ch)
            narrow = lower + t_level * (upper - lower)
            diffuse = visible * irradiance + indirect[ch]
            near = visible_s * narrow + incident * bounced[ch] + blocked * indirect[ch]
            light = near + share * (diffuse - near)
            reflectance = metal_colour * scale + metal * bias + (_1 - metal) * dielectric
            linear = albedo * transmitted * diffuse + light * reflectance + emission[ch]
            encoded, slope = srgb_and_slope(min(max(linear, _0), _1))
            error = encoded - colour[i, ch]
            squares += error * error
            length = math.sqrt(error * error + robust * robust)
            loss += length - robust
            g = _0
            if _0 <= linear <= _1:
                g = third * w * error / length * slope
            gradient[i, ch] = g * transmitted * diffuse
            gradient[i, 3 + ch] = g * light * scale
            g_metal += g * light * (bias - dielectric)
            g_scale += g * light * metal_colour
            g_bias += g * light * metal
            g_dielectric += g * (light * (_1 - metal) - albedo * diffuse)
            g_light = g * reflectance
            g_share += g_light * (diffuse - near)
            g_narrow = g_light * (_1 - share) * visible_s
            g_t += g_narrow * (upper - lower)
            du, dv = _bilinear_backward(table, table_grad, base0, stride0, fx0, fy0, ch, g_narrow * (_1 - t_level))
            g_u += du * half0
            g_v += dv * half0
            du, dv = _bilinear_backward(table, table_grad, base1, stride1, fx1, fy1, ch, g_narrow * t_level)
            g_u += du * half1
            g_v += dv * half1
            g_irradiance = visible * (g * albedo * transmitted + g_light * share)
            du, dv = _bilinear_backward(table, table_grad, base2, stride2, fx2, fy2, ch, g_irradiance)
            g_un += du * half2
            g_vn += dv * half2
        loss_sum += w * residual_weight * loss
        square_sum += w * squares
        weight_sum += w

        gx, gy, gz = _encode_backward(rx, ry, rz, g_u, g_v)
        g_along = gx * nx + gy * ny + gz * nz
        g_mirror = (_2 * c - _1) * g_along - (gx * vx + gy * vy + gz * vz)
        # Split-sum table: derivatives along √(n·v) and roughness. Visibility and reflected radiance count as constants.
        g_rough = g_t / (knots[level + 1] - knots[level])
        d_root = d_row = _0
        for k, g in ((0, g_scale), (1, g_bias), (2, g_share), (3, g_rough), (4, g_mirror), (5, g_dielectric)):
            along_root, along_row = _table_slopes(lut, row, col, fx, fy, k)
            d_root += g * along_root
            d_row += g * along_row
        g_c = d_root * np.float32(lut.shape[1] - 1) * _HALF / root * _HALF * (_1 + c / soft_root) + _2 * mirror * g_along
        gradient[i, 6] = d_row * np.float32(lut.shape[0] - 1)
        hx, hy, hz = _encode_backward(nx, ny, nz, g_un, g_vn)
        hx += coeff * gx + g_c * vx
        hy += coeff * gy + g_c * vy
        hz += coeff * gz + g_c * vz
        radial = hx * nx + hy * ny + hz * nz
        keep = inverse if inverse * inverse * MIN_SQUARED_LENGTH < _1 else _0
        gradient[i, 7] = keep * (hx - radial * nx)
        gradient[i, 8] = keep * (hy - radial * ny)
        gradient[i, 9] = keep * (hz - radial * nz)
        gradient[i, 10] = g_metal
    sums[0] += loss_sum / 3
    sums[1] += square_sum / 3
    sums[2] += weight_sum


@kernel("i4[::1], i8[::1], i4[::1], f4[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1]", parallel=True, **_FLAGS)
def gather_gradient(touched: Any, start: Any, pixel: Any, share: Any, gradient: Any, values: Any, out: Any) -> None:
    """Set rows `touched` (m,) of `out` (texels, PARAMETERS) to the gradient of the texels' parameters `values` (texels, PARAMETERS).

    It is the sum of `share` (e,) times `gradient` (n, SHADING) of `pixel` (e,), by the chain rule through diffuse and metallic albedo. The
    entries of the texel touched[j] are start[j] … start[j + 1].
    """
    for j in prange(touched.shape[0]):
        t = np.uint64(touched[j])
        a0 = a1 = a2 = f0 = f1 = f2 = rough = x = y = z = m = _0
        for e in range(start[j], start[j + 1]):
            p = np.uint64(pixel[e])
            w = share[e]
            a0 += w * gradient[p, 0]
            a1 += w * gradient[p, 1]
            a2 += w * gradient[p, 2]
            f0 += w * gradient[p, 3]
            f1 += w * gradient[p, 4]
            f2 += w * gradient[p, 5]
            rough += w * gradient[p, 6]
            x += w * gradient[p, 7]
            y += w * gradient[p, 8]
            z += w * gradient[p, 9]
            m += w * gradient[p, 10]
        metal = values[t, 4]
        out[t, 0] = (_1 - metal) * a0 + metal * f0
        out[t, 1] = (_1 - metal) * a1 + metal * f1
        out[t, 2] = (_1 - metal) * a2 + metal * f2
        out[t, 3] = rough
        b0, b1, b2 = values[t, 0], values[t, 1], values[t, 2]
        out[t, 4] = m + b0 * (f0 - a0) + b1 * (f1 - a1) + b2 * (f2 - a2)
        out[t, 5] = x
        out[t, 6] = y
        out[t, 7] = z


@kernel(
    (*argument_types("f4[:, ::1], f4[:, ::1], i4[::1]"), _LOCAL, _TRANSPORT, *argument_types(f"{_TABLES}, f4[:, ::1], f4[:, ::1]")),
    parallel=True, **_FLAGS,
)  # fmt: skip
def incident_light(
    normal: Any, view: Any, reflected: Any, local: Any, transport: Any, table: Any, knots: Any, sizes: Any, offsets: Any, lut: Any,
    diffuse: Any, bounced: Any,
) -> None:  # fmt: skip
    """Of the light of n pixels what does not depend on their roughness, (n, 3) each: the `diffuse` light, and the radiance `bounced` of the
    texel that the reflected ray meets.

    `local` (n,) of `LOCAL` is the light transport of pixels, `transport` (texels,) of `TRANSPORT` that of the texels that they reflect.
    """
    last = sizes.shape[0] - 1
    for pixel in prange(normal.shape[0]):
        i = np.uint64(pixel)
        _, nx, ny, nz, c = _geometry(normal, view, i)
        u, v = _encode(nx, ny, nz)
        base, stride, fx, fy = _taps(u, v, sizes[last], offsets[last])
        for ch in range(3):
            diffuse[i, ch] = local[i].visibility * _bilinear(table, base, stride, fx, fy, ch) + local[i].indirect[ch]
            bounced[i, ch] = _0
        if reflected.shape[0] > 0 and reflected[i] >= 0:
            two = _2 * c
            x, y, z = two * nx - view[i, 0], two * ny - view[i, 1], two * nz - view[i, 2]
            reflected_radiance(transport, np.uint64(reflected[i]), x, y, z, table, knots, sizes, offsets, lut, bounced[i])


@kernel(
    (*argument_types("i8[::1], f4[:, ::1], f4[:, ::1], i4[::1]"), _LOCAL,
     *argument_types(f"f4[:, ::1], f4[:, ::1], f4[::1], {_TABLES}, f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1]")),
    parallel=True, **_FLAGS,
)  # fmt: skip
def linear_shading(
    texel: Any, normal: Any, view: Any, reflected: Any, local: Any, wide: Any, bounced: Any, rough: Any, table: Any, knots: Any,
    sizes: Any, offsets: Any, lut: Any, diffuse: Any, specular: Any, scaled: Any, edge: Any,
) -> None:  # fmt: skip
    """Shading of n pixels as a linear function of base colour b, without what they emit.

    A dielectric shows b · `diffuse` + `specular`, a metal b · `scaled` + `edge`; (n, 3) each. `texel` (n,) is the texel whose roughness
    `rough` (texels,) counts; `local` (n,) the light transport of pixels; `wide`, `bounced` (n, 3) their diffuse light and the radiance
    that they reflect, of `incident_light`.
    """
    for pixel in prange(normal.shape[0]):
        i = np.uint64(pixel)
        roughness = rough[texel[i]]
        _, nx, ny, nz, c = _geometry(normal, view, i)
        vx, vy, vz = view[i, 0], view[i, 1], view[i, 2]
        soft = _HALF * (c + math.sqrt(c * c + _CLAMP_TERM))
        row, col, fx, fy = _table_cell(math.sqrt(soft), roughness, lut)
        scale = _table_value(lut, row, col, fx, fy, 0)
        bias = _table_value(lut, row, col, fx, fy, 1)
        share = _table_value(lut, row, col, fx, fy, 2)
        mirror = _table_value(lut, row, col, fx, fy, 4)
        dielectric = _table_value(lut, row, col, fx, fy, 5)
        transmitted = _1 - dielectric
        coeff = _1 + mirror * (_2 * c - _1)
        u, v = _encode(coeff * nx - mirror * vx, coeff * ny - mirror * vy, coeff * nz - mirror * vz)
        level, t = _roughness_level(_table_value(lut, row, col, fx, fy, 3), knots)
        base0, stride0, fx0, fy0 = _taps(u, v, sizes[level], offsets[level])
        base1, stride1, fx1, fy1 = _taps(u, v, sizes[level + 1], offsets[level + 1])
        visible_s, blocked, incident, _ = specular_visibility(soft, roughness, local[i].occlusion, reflected, i)
        for ch in range(3):
            lower = _bilinear(table, base0, stride0, fx0, fy0, ch)
            upper = _bilinear(table, base1, stride1, fx1, fy1, ch)
            narrow = lower + t * (upper - lower)
            near = visible_s * narrow + incident * bounced[i, ch] + blocked * local[i].indirect[ch]
            light = near + share * (wide[i, ch] - near)
            diffuse[i, ch] = transmitted * wide[i, ch]
            specular[i, ch] = light * dielectric
            scaled[i, ch] = light * scale
            edge[i, ch] = light * bias


@kernel("f4[:, ::1], i4[:, ::1], f4[:, ::1], f4[:, ::1]", parallel=True, **_FLAGS)
def interpolate_taps(values: Any, texel: Any, bilinear: Any, out: Any) -> None:
    """`out` (n, c): `values` (texels, c) at the taps `texel` (n, 4) with the weights `bilinear` (n, 4)."""
    for i in prange(texel.shape[0]):
        for c in range(values.shape[1]):
            total = _0
            for k in range(4):
                total += bilinear[i, k] * values[texel[i, k], c]
            out[i, c] = total
