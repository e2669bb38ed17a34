"""Distant light for refinement: a small octahedral map at three blurs, which stand for three roughnesses.

A blur is a von Mises–Fisher lobe over the sphere with the standard deviation of LOBES; the maps are linear in the light, so that it follows
from the photos by linear least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gsbake.shading.octahedral import border_indices, encode_array, texel_directions

Floats = NDArray[np.float32]

#: Standard deviation of the lobes in degrees; 0 is a mirror.
LOBES = (0.0, 12.0, 30.0)


@dataclass(frozen=True)
class ReflectionMap:
    """Light from all directions: `radiance` (size², 3), linear RGB, texels in row-major order."""

    size: int
    radiance: Floats

    @staticmethod
    def constant(size: int, level: float) -> ReflectionMap:
        """Light of `level` from everywhere."""
        return ReflectionMap(size, np.full((size * size, 3), level, np.float32))

    def blurred(self, radiance: Floats | None = None) -> list[Floats]:
        """The radiance (size², 3), by default the map's, at each blur of LOBES."""
        values = self.radiance if radiance is None else radiance
        return [values if lobe is None else lobe @ values for lobe in lobes(self.size)]

    def gathered(self, values: Floats) -> Floats:
        """The transpose of `blurred`: the sum (size², 3) of `values` (lobes, size², 3), each blurred backwards."""
        parts = [part if lobe is None else lobe.T @ part for part, lobe in zip(values, lobes(self.size), strict=True)]
        return np.asarray(sum(parts[1:], parts[0]), np.float32)

    def tables(self) -> Floats:
        """Maps (lobes, size + 2, size + 2, 3) for interpolation, with a border of one texel."""
        return np.ascontiguousarray(np.stack(self.blurred())[:, border_indices(self.size)], np.float32)

    def resampled(self, size: int) -> ReflectionMap:
        """The same light in another size, interpolated bilinearly."""
        table = self.tables()[0]
        u, v = encode_array(texel_directions(size))
        column, row = ((u + 1) * 0.5 * self.size + 0.5), ((v + 1) * 0.5 * self.size + 0.5)
        i, j = np.clip(row.astype(int), 0, self.size), np.clip(column.astype(int), 0, self.size)
        b, a = (row - i)[:, None], (column - j)[:, None]
        top, bottom = (1 - a) * table[i, j] + a * table[i, j + 1], (1 - a) * table[i + 1, j] + a * table[i + 1, j + 1]
        return ReflectionMap(size, np.asarray((1 - b) * top + b * bottom, np.float32))


@lru_cache(maxsize=4)
def lobes(size: int) -> tuple[Floats | None, ...]:
    """Matrices (size², size²) of the blurs, rows of sum 1; None of the mirror."""
    directions = texel_directions(size)
    # A texel's solid angle is that of the octahedron's flat face seen from the centre: ∝ distance⁻³, and distance⁻¹ = |x| + |y| + |z|.
    area = np.abs(directions).sum(1) ** 3
    found: list[Floats | None] = []
    for degrees in LOBES:
        if not degrees:
            found.append(None)
            continue
        lobe = np.exp((directions @ directions.T - 1) / np.radians(degrees) ** 2) * area
        found.append(np.asarray(lobe / lobe.sum(1, keepdims=True), np.float32))
    return tuple(found)


@lru_cache(maxsize=4)
def laplacian(size: int) -> sparse.csr_matrix:
    """Graph Laplacian (size², size²) of the texels, each with its neighbour to the right and below, across the map's borders too."""
    index = border_indices(size)
    here = np.repeat(index[1:-1, 1:-1].ravel(), 2)
    there = np.stack([index[1:-1, 2:], index[2:, 1:-1]], -1).ravel()
    keep = here != there
    ones = np.ones(int(keep.sum()), np.float32)
    adjacency = sparse.csr_matrix((ones, (here[keep], there[keep])), (size * size, size * size))
    adjacency = adjacency + adjacency.T
    return (sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsr()
