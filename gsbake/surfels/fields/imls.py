"""The discretized SDF as an implicit moving-least-squares field.

Each surfel, projected onto the zero set by its own SDF sample (μ' = μ − s n), is an oriented point.
f(x) = Σ wᵢ nᵢ·(x − μ'ᵢ) / Σ wᵢ is a smooth signed distance near them (Kolluri, *Provably good moving least squares*, SODA 2005), with
weights of compact support whose radius follows the local spacing. Each sample is splatted onto the lattice within its radius, so the cost
grows with the number of surfels, not with the box. A second pass down-weights samples whose plane deviates from the first field:
outliers and the opposite side of thin parts (after Öztireli et al., *Feature preserving point set surfaces based on non-linear kernel
regression*, Eurographics 2009).
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gsbake.geometry.sparse_lattice import EDGE, BlockLattice, Floats

#: Support radius in units of the local spacing: about 25 samples contribute at each point.
SUPPORT_FACTOR = 2.8
#: Rank of the neighbour whose distance gives the local spacing.
NEIGHBOURS = 8
#: Minimum sum of weights of a known value (1 = one sample at distance 0).
MIN_WEIGHT_SUM = 0.02


def support_radii(points: NDArray[np.float64], minimum: float, maximum: float) -> Floats:
    """Support radius (n,) of each sample from its distance to its neighbours, within `minimum`..`maximum` (world units)."""
    k = min(NEIGHBOURS, len(points) - 1)
    if k < 1:
        return np.full(len(points), minimum, np.float32)
    neighbour_distance = cKDTree(points).query(points, k=[k + 1])[0][:, 0]
    spacing = neighbour_distance * np.sqrt(np.pi / k)  # k samples lie on a disc of this radius
    return np.clip(SUPPORT_FACTOR * spacing, minimum, maximum).astype(np.float32)


def imls_field(
    lattice: BlockLattice,
    points: ArrayLike,
    normals: ArrayLike,
    truncation: float,
    weights: ArrayLike | None = None,
    max_support: float | None = None,
    robust: bool = True,
) -> Floats:
    """The field (n, 8, 8, 8) on the lattice's blocks in units of `truncation`, clamped to ±1; NaN where no sample reaches.

    `points` (m, 3) lie on the surface; `normals` (m, 3) are unit and outward; `weights` (m,) default to 1; `max_support` is the maximum
    support radius (default: eight cells). `robust` makes the second pass. Samples that are not finite are ignored. Raises ValueError when
    the row counts differ.
    """
    position = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    normal = np.ascontiguousarray(normals, np.float32).reshape(-1, 3)
    confidence = np.ones(len(position), np.float32) if weights is None else np.ascontiguousarray(weights, np.float32)
    if not (len(normal) == len(confidence) == len(position)):
        raise ValueError("points, normals and weights must have one row per sample")
    finite = np.isfinite(position).all(1) & np.isfinite(normal).all(1) & np.isfinite(confidence)
    position, normal, confidence = position[finite], normal[finite], confidence[finite]
    sums = np.zeros((len(lattice), EDGE, EDGE, EDGE), np.float32)
    weight_sum = np.zeros_like(sums)
    if len(position) > 1:
        cell = lattice.cell
        radii = support_radii(position, 1.8 * cell, max_support or 8 * cell) / np.float32(cell)
        scaled = ((position - lattice.lower) / cell).astype(np.float32)
        _splat(lattice.index, scaled, normal, confidence, radii, sums, weight_sum, np.zeros((0, EDGE, EDGE, EDGE), np.float32))
        if robust:
            first_field = np.where(weight_sum > 0, sums / np.maximum(weight_sum, 1e-12), 0).astype(np.float32)
            sums[:] = 0
            weight_sum[:] = 0
            _splat(lattice.index, scaled, normal, confidence, radii, sums, weight_sum, first_field)
    known = weight_sum > MIN_WEIGHT_SUM
    field = np.where(known, sums * np.float32(lattice.cell / truncation) / np.maximum(weight_sum, 1e-12), np.nan)
    return np.clip(field, -1, 1).astype(np.float32)


@nb.njit(cache=True, error_model="numpy")
def _splat(index: Any, scaled: Any, normal: Any, confidence: Any, radii: Any, sums: Any, weight_sum: Any, first_field: Any) -> None:
    """Add every sample's plane to the lattice samples within its radius; lengths in cells. `first_field` is empty in the first pass."""
    sizes = (index.shape[0] * EDGE, index.shape[1] * EDGE, index.shape[2] * EDGE)
    robust = first_field.shape[0] > 0
    for m in range(scaled.shape[0]):
        radius = radii[m]
        x, y, z = scaled[m, 0], scaled[m, 1], scaled[m, 2]
        inverse = np.float32(1) / (radius * radius)
        for i in range(max(0, int(np.ceil(x - radius))), min(sizes[0] - 1, int(x + radius)) + 1):
            dx = i - x
            for j in range(max(0, int(np.ceil(y - radius))), min(sizes[1] - 1, int(y + radius)) + 1):
                dy = j - y
                for k in range(max(0, int(np.ceil(z - radius))), min(sizes[2] - 1, int(z + radius)) + 1):
                    dz = k - z
                    falloff = np.float32(1) - (dx * dx + dy * dy + dz * dz) * inverse
                    if falloff <= 0:
                        continue
                    row = index[i // EDGE, j // EDGE, k // EDGE]
                    if row < 0:
                        continue
                    a, b, c = i % EDGE, j % EDGE, k % EDGE
                    distance = normal[m, 0] * dx + normal[m, 1] * dy + normal[m, 2] * dz
                    weight = confidence[m] * falloff * falloff * falloff * falloff
                    if robust:
                        # Half weight at a deviation of a quarter of the radius from the first field.
                        deviation = (distance - first_field[row, a, b, c]) * np.float32(4) / radius
                        weight /= np.float32(1) + deviation * deviation
                    sums[row, a, b, c] += weight * distance
                    weight_sum[row, a, b, c] += weight
