"""Adjacency of texels on the surface: neighbours in the texture, and neighbours across seams between charts.

At a seam the texels of either chart reach its border, so a texel of one lies within about a texel's width of one of the other, though far
from it in the texture. Texels of two charts that are merely packed side by side are not adjacent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.texturing.texels import Texels

Pairs = NDArray[np.int64]

#: Largest distance of neighbours within a chart and across a seam, in median distances of adjacent texels.
MAX_CHART_DISTANCE, MAX_SEAM_DISTANCE = 4.0, 1.5
#: Candidates across the seam for every texel at a chart's border, and their least distance in the texture in texels.
SEAM_CANDIDATES, MIN_TEXTURE_DISTANCE = 8, 4
#: Least cosine of normals across a seam: the other side of a thin sheet is another surface.
MIN_NORMAL_COSINE = 0.5
#: Pairs are shuffled in blocks of about this many, for memory locality.
SHUFFLE_BLOCK = 256


def neighbours(texels: Texels, position: NDArray[Any], normal: NDArray[Any]) -> Pairs:
    """Pairs (m, 2) of adjacent texels at `position` (n, 3) with `normal` (n, 3) of any length, in a fixed shuffled order."""
    p = np.asarray(position, np.float64)
    grid = _grid_neighbours(texels)
    distance = np.linalg.norm(p[grid[:, 0]] - p[grid[:, 1]], axis=1)
    width = float(np.median(distance)) if len(distance) else 0.0
    grid = grid[distance <= MAX_CHART_DISTANCE * width]
    pairs = np.concatenate([grid, _seam_neighbours(texels, p, np.asarray(normal, np.float64), grid, MAX_SEAM_DISTANCE * width)])
    blocks = np.array_split(pairs, max(1, len(pairs) // SHUFFLE_BLOCK))
    np.random.default_rng(0).shuffle(blocks)
    return np.concatenate(blocks) if blocks else pairs


def _grid_neighbours(texels: Texels) -> Pairs:
    """Pairs (m, 2) that share an edge in the texture."""
    index = texels.lookup.reshape(texels.size, texels.size)
    pairs = []
    for a, b in ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:])):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]], 1))
    return np.concatenate(pairs)


def _seam_neighbours(texels: Texels, position: NDArray[np.float64], normal: NDArray[np.float64], grid: Pairs, radius: float) -> Pairs:
    """Pairs (m, 2) of border texels of different charts within `radius`; `grid` are the pairs within charts."""
    border = np.flatnonzero(np.bincount(grid.ravel(), minlength=len(texels)) < 4)
    if len(border) < 2 or not radius > 0:
        return np.zeros((0, 2), np.int64)
    count = min(SEAM_CANDIDATES, len(border))
    distance, found = cKDTree(position[border]).query(position[border], k=count, distance_upper_bound=radius)
    first, near = np.repeat(border, distance.shape[1]), np.isfinite(distance.ravel())
    first, second = first[near], border[found.ravel()[near]]
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    row, column = np.divmod(texels.index, texels.size)
    far = np.maximum(np.abs(row[first] - row[second]), np.abs(column[first] - column[second])) >= MIN_TEXTURE_DISTANCE
    same_side = np.einsum("nd,nd->n", unit[first], unit[second]) > MIN_NORMAL_COSINE
    return np.unique(np.sort(np.stack([first, second], 1)[far & same_side], axis=1), axis=0)


def neighbour_lists(pairs: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The neighbours of each of `count` texels in the `pairs` (m, 2): `start` (count + 1,) and the list they lie in."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.argsort(both[:, 0], kind="stable")
    start = np.searchsorted(both[order, 0], np.arange(count + 1))
    return start, both[order, 1].astype(np.int32)
