"""Plain float64 twins of the kernels, for tests: one vertex and one photo at a time, from the formulas of `reflection_kernel`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.shading.octahedral import encode_array
from gsbake.shape_refinement.reflection_kernel import F0, KIND_COUNT, LOBE_COUNT

Doubles = NDArray[np.float64]


def sample_reference(point: Doubles, camera: Camera, photo: NDArray[Any]) -> Doubles:
    """Bilinear colour (3,) of a photo (h, w, 3) where `point` (3,) projects, which lies at least a pixel inside."""
    pixel, _ = camera.project(point[None])
    u, v = pixel[0] - 0.5
    column, row = int(np.floor(u)), int(np.floor(v))
    a, b = u - column, v - row
    corners = photo[row : row + 2, column : column + 2].astype(np.float64)
    return np.asarray((1 - b) * ((1 - a) * corners[0, 0] + a * corners[0, 1]) + b * ((1 - a) * corners[1, 0] + a * corners[1, 1]))


def reflection_reference(direction: Doubles, normal: Doubles, tables: NDArray[Any], kind: int) -> Doubles:
    """Reflected light (3,) of a vertex of `kind` towards the unit `direction`; `normal` need not have unit length, as in the kernel."""
    cosine = float(direction @ normal)
    mirrored = 2 * cosine * normal - direction
    size = tables.shape[1] - 2
    u, v = (float(x[0]) for x in encode_array(mirrored[None]))
    column, row = (u + 1) * 0.5 * size + 0.5, (v + 1) * 0.5 * size + 0.5
    j, i = min(max(int(column), 0), size), min(max(int(row), 0), size)
    a, b = column - j, row - i
    table = tables[kind % LOBE_COUNT].astype(np.float64)
    value = (1 - b) * ((1 - a) * table[i, j] + a * table[i, j + 1]) + b * ((1 - a) * table[i + 1, j] + a * table[i + 1, j + 1])
    if kind < LOBE_COUNT:
        return np.asarray(value)
    return np.asarray(value * (F0 + (1 - F0) * (1 - np.clip(cosine, 0, 1)) ** 5) / F0)


def moments_reference(weights: Doubles, colours: Doubles, lights: Doubles) -> Doubles:
    """Moments (7 + 9 · KIND_COUNT,) of one vertex: `weights` (photos,), `colours` (photos, 3), `lights` (photos, KIND_COUNT, 3)."""
    total = weights.sum()
    mean = (weights[:, None] * colours).sum(0) / total
    centred = colours - mean
    out = [np.array([total]), mean, (weights[:, None] * centred**2).sum(0)]
    for kind in range(KIND_COUNT):
        mean_light = (weights[:, None] * lights[:, kind]).sum(0) / total
        difference = lights[:, kind] - mean_light
        out += [mean_light, (weights[:, None] * difference**2).sum(0), (weights[:, None] * centred * difference).sum(0)]
    return np.concatenate(out)


def rows_reference(weights: Doubles, errors: Doubles, rows: Doubles, variance: float) -> tuple[Doubles, Doubles]:
    """Hessian (3, 3) and gradient (3,) of one vertex from `errors` (photos, 3) and their derivatives `rows` (photos, 3 channels, 3
    unknowns), centred over the photos."""
    total = weights.sum()
    centred = errors - (weights[:, None] * errors).sum(0) / total
    slopes = rows - (weights[:, None, None] * rows).sum(0) / total
    scale = weights / variance
    hessian = np.einsum("p,pci,pcj->ij", scale, slopes, slopes)
    return hessian, np.einsum("p,pci,pc->i", scale, slopes, centred)

