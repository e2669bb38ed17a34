"""Kernels of the reflected light at vertices: moments for the appearance, sums for the light, rows for the shape.

    I_vj = c_v + s_v · F(n·w) · L(reflect(w, n))        v vertex, j photo, w direction to the camera

with F = 1 of metals and Schlick's Fresnel term over its value at normal incidence of dielectrics. A vertex's *kind* is its lobe plus, of
dielectrics, the number of lobes. The diffuse colour c is eliminated by centring over the photos (variable projection: Golub & Pereyra,
*The differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate*, SIAM J. Numer. Anal. 1973).
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from gsbake.kernels.declaration import kernel

#: Lobes of a map, and kinds of a vertex.
LOBE_COUNT, KIND_COUNT = 3, 6
#: Reflectance of dielectrics at normal incidence.
F0 = 0.04
#: Squared residuals over their variance are damped beyond this (Cauchy).
_CAUCHY = 4.0


@numba.njit(cache=True, error_model="numpy", fastmath=False)
def reflect_position(d0: float, d1: float, d2: float, n0: float, n1: float, n2: float, size: int) -> Any:
    """Where the reflection of direction d in normal n falls: row, column, their fractions in a table with border, and the cosine."""
    cosine = d0 * n0 + d1 * n1 + d2 * n2
    x, y, z = 2 * cosine * n0 - d0, 2 * cosine * n1 - d1, 2 * cosine * n2 - d2
    scale = 1.0 / (abs(x) + abs(y) + abs(z) + 1e-20)
    p, q = x * scale, y * scale
    if z < 0:
        p, q = (1 - abs(q)) * (1.0 if p >= 0 else -1.0), (1 - abs(p)) * (1.0 if q >= 0 else -1.0)
    column, row = (p + 1) * 0.5 * size + 0.5, (q + 1) * 0.5 * size + 0.5
    j, i = min(max(int(column), 0), size), min(max(int(row), 0), size)
    return i, j, row - i, column - j, cosine


@numba.njit(cache=True, error_model="numpy", fastmath=False)
def fresnel(cosine: float, dielectric: bool) -> float:
    """Schlick's Fresnel term over its value at normal incidence; 1 of metals."""
    if not dielectric:
        return 1.0
    m = 1 - min(max(cosine, 0.0), 1.0)
    return (F0 + (1 - F0) * m * m * m * m * m) / F0


@kernel(
    "i8, i8, f8[:, ::1], f8[:, ::1], f8[:, ::1], f4[:, :, ::1], f4[:, ::1], f4[:, ::1], f4[:, :, :, ::1], f4[:, ::1]",
    error_model="numpy", nogil=True,
)
def measure_moments(
    start: int, stop: int, vertices: Any, normals: Any, centres: Any, colour: Any, weight: Any, robust: Any, tables: Any, out: Any
) -> None:  # fmt: skip
    """Weighted moments over the photos of each vertex start..stop, in the columns of `out` (v, 1 + 6 + 9 · KIND_COUNT): sum of weights;
    means (3) and variances (3) times the weights of the colour; then for each kind, means (3), variances (3) and covariances (3) with the
    colour of the reflected light, the latter two times the weights."""
    photos = weight.shape[1]
    size = tables.shape[1] - 2
    light = np.empty((photos, KIND_COUNT, 3))
    for v in range(start, stop):
        out[v, :] = 0
        total = 0.0
        mean, mean_light = np.zeros(3), np.zeros((KIND_COUNT, 3))
        for j in range(photos):
            w = weight[v, j] * robust[v, j]
            if w <= 0:
                continue
            d0, d1, d2 = centres[j, 0] - vertices[v, 0], centres[j, 1] - vertices[v, 1], centres[j, 2] - vertices[v, 2]
            length = 1.0 / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            i, k, b, a, cosine = reflect_position(
                d0 * length, d1 * length, d2 * length, normals[v, 0], normals[v, 1], normals[v, 2], size
            )
            factor = fresnel(cosine, True)
            total += w
            for lobe in range(LOBE_COUNT):
                for c in range(3):
                    top = (1 - a) * tables[lobe, i, k, c] + a * tables[lobe, i, k + 1, c]
                    value = (1 - b) * top + b * ((1 - a) * tables[lobe, i + 1, k, c] + a * tables[lobe, i + 1, k + 1, c])
                    light[j, lobe, c], light[j, lobe + LOBE_COUNT, c] = value, factor * value
                    mean_light[lobe, c] += w * value
                    mean_light[lobe + LOBE_COUNT, c] += w * factor * value
            for c in range(3):
                mean[c] += w * colour[v, j, c]
        if total <= 0:
            continue
        mean /= total
        mean_light /= total
        out[v, 0] = total
        for c in range(3):
            out[v, 1 + c] = mean[c]
            for kind in range(KIND_COUNT):
                out[v, 7 + 9 * kind + c] = mean_light[kind, c]
        for j in range(photos):
            w = weight[v, j] * robust[v, j]
            if w <= 0:
                continue
            for c in range(3):
                centred = colour[v, j, c] - mean[c]
                out[v, 4 + c] += w * centred * centred
                for kind in range(KIND_COUNT):
                    centred_light = light[j, kind, c] - mean_light[kind, c]
                    out[v, 10 + 9 * kind + c] += w * centred_light * centred_light
                    out[v, 13 + 9 * kind + c] += w * centred * centred_light


@kernel(
    "i8, i8, i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f4[:, ::1], f4[:, ::1], i8[::1], i8, i8[::1], i4[:, ::1], f4[:, ::1]",
    error_model="numpy", nogil=True,
)
def locate_reflections(
    start: int, stop: int, rows: Any, vertices: Any, normals: Any, centres: Any, weight: Any, robust: Any, kind: Any, size: int,
    first: Any, place: Any, factors: Any,
) -> None:  # fmt: skip
    """Where the reflections of the vertices rows[start..stop] fall: one entry per photo that sees one, from `first` (rows + 1) on, with
    `place` (entries, 2) photo and i · (size + 2) + j, and `factors` (entries, 4) row and column fraction, Fresnel factor and weight."""
    photos = weight.shape[1]
    for r in range(start, stop):
        v, entry = rows[r], first[r]
        for j in range(photos):
            if weight[v, j] <= 0:
                continue
            d0, d1, d2 = centres[j, 0] - vertices[v, 0], centres[j, 1] - vertices[v, 1], centres[j, 2] - vertices[v, 2]
            length = 1.0 / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            i, k, b, a, cosine = reflect_position(
                d0 * length, d1 * length, d2 * length, normals[v, 0], normals[v, 1], normals[v, 2], size
            )
            place[entry, 0], place[entry, 1] = j, i * (size + 2) + k
            factors[entry, 0], factors[entry, 1] = b, a
            factors[entry, 2], factors[entry, 3] = fresnel(cosine, kind[v] >= LOBE_COUNT), weight[v, j] * robust[v, j]
            entry += 1


@kernel(
    "i8, i8, i8[::1], i8[::1], i4[:, ::1], f4[:, ::1], i8[::1], f4[:, ::1], f4[::1], f4[:, :, ::1], f4[:, :, ::1], f8[:, :, ::1]",
    error_model="numpy", nogil=True,
)
def apply_light(
    start: int, stop: int, rows: Any, first: Any, place: Any, factors: Any, kind: Any, scale: Any, importance: Any, tables: Any,
    colour: Any, out: Any,
) -> None:  # fmt: skip
    """Add AᵀCWC(A·light + colour) to `out` (lobes, (size + 2)², 3) of the vertices rows[start..stop]: A takes light to reflections, C
    centres over a vertex's photos, W are the weights times the vertex's `importance` (v,). `tables` (lobes, (size + 2)², 3) the light,
    `colour` (v, photos, 3) values added to its reflections (the photos' for the right side of the equations), or (0, 0, 3) for none."""
    longest = 0
    for r in range(start, stop):
        longest = max(longest, first[r + 1] - first[r])
    value = np.empty((longest, 3))
    stride = int(np.sqrt(np.float64(tables.shape[1])) + 0.5)
    with_colour = colour.shape[0] > 0
    for r in range(start, stop):
        v = rows[r]
        lobe = kind[v] % LOBE_COUNT
        total = 0.0
        mean = np.zeros(3)
        for entry in range(first[r], first[r + 1]):
            at = place[entry, 1]
            b, a, amplitude, w = factors[entry, 0], factors[entry, 1], factors[entry, 2], factors[entry, 3]
            total += w
            for c in range(3):
                top = (1 - a) * tables[lobe, at, c] + a * tables[lobe, at + 1, c]
                bottom = (1 - a) * tables[lobe, at + stride, c] + a * tables[lobe, at + stride + 1, c]
                found = amplitude * scale[v, c] * ((1 - b) * top + b * bottom)
                if with_colour:
                    found += colour[v, place[entry, 0], c]
                value[entry - first[r], c] = found
                mean[c] += w * found
        if total <= 0:
            continue
        for entry in range(first[r], first[r + 1]):
            at = place[entry, 1]
            b, a, amplitude, w = factors[entry, 0], factors[entry, 1], factors[entry, 2], factors[entry, 3]
            for c in range(3):
                back = importance[v] * w * (value[entry - first[r], c] - mean[c] / total) * amplitude * scale[v, c]
                out[lobe, at, c] += (1 - b) * (1 - a) * back
                out[lobe, at + 1, c] += (1 - b) * a * back
                out[lobe, at + stride, c] += b * (1 - a) * back
                out[lobe, at + stride + 1, c] += b * a * back


@kernel(
    "i8, i8, f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f4[:, :, ::1], f4[:, :, ::1], f4[:, ::1], f4[:, ::1], f4[:, :, :, ::1], "
    "i8[::1], f4[:, ::1], f4[:, ::1], f4[::1], f8, f8[:, ::1], f8[:, ::1], f4[:, ::1]",
    error_model="numpy", nogil=True,
)
def gauss_newton_rows(
    start: int, stop: int, vertices: Any, normals: Any, tangents: Any, centres: Any, colour: Any, slope: Any, weight: Any, robust: Any,
    tables: Any, kind: Any, scale: Any, diffuse: Any, variance: Any, step: float, hessian: Any, gradient: Any, residual: Any,
) -> None:  # fmt: skip
    """Sums over the photos of each vertex start..stop, rows centred: `hessian` (v, 4) of displacement and of the surface gradient
    (dd, 11, 12, 22), `gradient` (v, 3) (d, 1, 2), both over the `variance` (v,); `residual` (v, 2) mean squared residual of a photo, summed
    over the channels, and mean squared slope. `robust` (v, photos) gets the weights of the residuals.

    The normal follows the gradient of the displacement d: n' = n − ∇d, along `tangents` (v, 2, 3). ∂L/∂n is a central difference of `step`
    radians, the map's resolution.
    """
    photos = weight.shape[1]
    size = tables.shape[1] - 2
    error, row, used = np.empty((photos, 3)), np.empty((photos, 3, 3)), np.empty(photos)
    light = np.empty((5, 3))
    for v in range(start, stop):
        hessian[v, :] = 0
        gradient[v, :] = 0
        residual[v, :] = 0
        lobe, dielectric = kind[v] % LOBE_COUNT, kind[v] >= LOBE_COUNT
        total = seen = squares = slopes = 0.0
        mean_error, mean_row = np.zeros(3), np.zeros((3, 3))
        for j in range(photos):
            used[j] = 0
            if weight[v, j] <= 0:
                continue
            d0, d1, d2 = centres[j, 0] - vertices[v, 0], centres[j, 1] - vertices[v, 1], centres[j, 2] - vertices[v, 2]
            length = 1.0 / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            d0, d1, d2 = d0 * length, d1 * length, d2 * length
            for q in range(5):
                n0, n1, n2 = normals[v, 0], normals[v, 1], normals[v, 2]
                if q > 0:
                    axis, offset = (q - 1) // 2, step if q % 2 else -step
                    n0 += offset * tangents[v, axis, 0]
                    n1 += offset * tangents[v, axis, 1]
                    n2 += offset * tangents[v, axis, 2]
                i, k, b, a, cosine = reflect_position(d0, d1, d2, n0, n1, n2, size)
                factor = fresnel(cosine, dielectric)
                for c in range(3):
                    top = (1 - a) * tables[lobe, i, k, c] + a * tables[lobe, i, k + 1, c]
                    light[q, c] = factor * (
                        (1 - b) * top + b * ((1 - a) * tables[lobe, i + 1, k, c] + a * tables[lobe, i + 1, k + 1, c])
                    )
            square = 0.0
            for c in range(3):
                error[j, c] = colour[v, j, c] - diffuse[v, c] - scale[v, c] * light[0, c]
                square += error[j, c] * error[j, c]
                slopes += weight[v, j] * slope[v, j, c] * slope[v, j, c]
                row[j, 0, c] = slope[v, j, c]
                row[j, 1, c] = scale[v, c] * (light[1, c] - light[2, c]) / (2 * step)
                row[j, 2, c] = scale[v, c] * (light[3, c] - light[4, c]) / (2 * step)
            squares += weight[v, j] * square
            seen += weight[v, j]
            robust[v, j] = 1.0 / (1.0 + square / (3 * variance[v] * _CAUCHY))
            used[j] = weight[v, j] * robust[v, j]
            total += used[j]
            for c in range(3):
                mean_error[c] += used[j] * error[j, c]
                for r in range(3):
                    mean_row[r, c] += used[j] * row[j, r, c]
        if total <= 0:
            continue
        residual[v, 0], residual[v, 1] = squares / seen, slopes / seen
        for j in range(photos):
            w = used[j] / variance[v]
            if w <= 0:
                continue
            for c in range(3):
                e = error[j, c] - mean_error[c] / total
                r0, r1 = row[j, 0, c] - mean_row[0, c] / total, row[j, 1, c] - mean_row[1, c] / total
                r2 = row[j, 2, c] - mean_row[2, c] / total
                hessian[v, 0] += w * r0 * r0
                hessian[v, 1] += w * r1 * r1
                hessian[v, 2] += w * r1 * r2
                hessian[v, 3] += w * r2 * r2
                gradient[v, 0] += w * r0 * e
                gradient[v, 1] += w * r1 * e
                gradient[v, 2] += w * r2 * e
