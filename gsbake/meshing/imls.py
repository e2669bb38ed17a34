"""The discretized SDF as an implicit moving-least-squares field.

Each surfel, moved onto the zero set by its own SDF sample (μ' = μ − s n), is an oriented point. Around them
f(x) = Σ wᵢ nᵢ·(x − μ'ᵢ) / Σ wᵢ is a smooth signed distance (Kolluri, *Provably good moving least squares*, SODA 2005), with weights of
compact support whose width follows the local spacing. Evaluated by splatting each sample onto the lattice around it, so the cost
grows with the surfels and not with the box. A second pass weakens samples whose plane disagrees with the first field, so outliers
and the far side of thin parts count less (after Öztireli et al., *Feature preserving point set surfaces based on non-linear kernel
regression*, Eurographics 2009).
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gsbake.meshing.sparse_lattice import EDGE, BlockLattice, Floats

#: Support radius in units of the local spacing: about 25 samples speak in each place.
SUPPORT = 2.8
#: Neighbour whose distance measures the local spacing.
NEIGHBOURS = 8
#: Where the weights sum to less than this (1 = a sample sits right here), nothing is known.
KNOWN = 0.02


def support_radii(points: NDArray[np.float64], least: float, most: float) -> Floats:
    """Support radius (n,) of each sample from its distance to its neighbours, within `least`..`most` (world units)."""
    k = min(NEIGHBOURS, len(points) - 1)
    if k < 1:
        return np.full(len(points), least, np.float32)
    reach = cKDTree(points).query(points, k=[k + 1])[0][:, 0]
    spacing = reach * np.sqrt(np.pi / k)  # k samples on a disc of this radius
    return np.clip(SUPPORT * spacing, least, most).astype(np.float32)


def imls_field(
    lattice: BlockLattice,
    points: ArrayLike,
    normals: ArrayLike,
    truncation: float,
    weights: ArrayLike | None = None,
    max_support: float | None = None,
    robust: bool = True,
) -> Floats:
    """The field (n, 8, 8, 8) on the lattice's blocks in units of `truncation`, kept in ±1; not a number where no sample reaches.

    `points` (m, 3) lie on the surface, `normals` (m, 3) unit and outward, `weights` (m,) their trust (1 each by default);
    `max_support` bounds the width of a sample (default: eight cells).
    """
    position = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    normal = np.ascontiguousarray(normals, np.float32).reshape(-1, 3)
    trust = np.ones(len(position), np.float32) if weights is None else np.ascontiguousarray(weights, np.float32)
    if not (len(normal) == len(trust) == len(position)):
        raise ValueError("points, normals and weights must have one row per sample")
    sums = np.zeros((len(lattice), EDGE, EDGE, EDGE), np.float32)
    mass = np.zeros_like(sums)
    if len(position) > 1:
        cell = lattice.cell
        radii = support_radii(position, 1.8 * cell, max_support or 8 * cell) / np.float32(cell)
        local = ((position - lattice.lower) / cell).astype(np.float32)
        _splat(lattice.index, local, normal, trust, radii, sums, mass, np.zeros((0, EDGE, EDGE, EDGE), np.float32))
        if robust:
            first = np.where(mass > 0, sums / np.maximum(mass, 1e-12), 0).astype(np.float32)
            sums[:] = 0
            mass[:] = 0
            _splat(lattice.index, local, normal, trust, radii, sums, mass, first)
    known = mass > KNOWN
    field = np.where(known, sums * np.float32(lattice.cell / truncation) / np.maximum(mass, 1e-12), np.nan)
    return np.clip(field, -1, 1).astype(np.float32)


@nb.njit(cache=True, error_model="numpy")
def _splat(index: Any, local: Any, normal: Any, trust: Any, radii: Any, sums: Any, mass: Any, first: Any) -> None:
    """Add every sample's plane to the lattice samples within its radius; all lengths in cells. `first`: an earlier field, or empty."""
    sizes = (index.shape[0] * EDGE, index.shape[1] * EDGE, index.shape[2] * EDGE)
    robust = first.shape[0] > 0
    for m in range(local.shape[0]):
        radius = radii[m]
        x, y, z = local[m, 0], local[m, 1], local[m, 2]
        inverse = np.float32(1) / (radius * radius)
        for i in range(max(0, int(np.ceil(x - radius))), min(sizes[0] - 1, int(x + radius)) + 1):
            dx = i - x
            for j in range(max(0, int(np.ceil(y - radius))), min(sizes[1] - 1, int(y + radius)) + 1):
                dy = j - y
                for k in range(max(0, int(np.ceil(z - radius))), min(sizes[2] - 1, int(z + radius)) + 1):
                    dz = k - z
                    fall = np.float32(1) - (dx * dx + dy * dy + dz * dz) * inverse
                    if fall <= 0:
                        continue
                    row = index[i // EDGE, j // EDGE, k // EDGE]
                    if row < 0:
                        continue
                    a, b, c = i % EDGE, j % EDGE, k % EDGE
                    distance = normal[m, 0] * dx + normal[m, 1] * dy + normal[m, 2] * dz
                    weight = trust[m] * fall * fall * fall * fall
                    if robust:
                        # Half weight at a quarter of the radius off the first field.
                        gap = (distance - first[row, a, b, c]) * np.float32(4) / radius
                        weight /= np.float32(1) + gap * gap
                    sums[row, a, b, c] += weight * distance
                    mass[row, a, b, c] += weight
