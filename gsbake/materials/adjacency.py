"""Which texels lie side by side on the surface: those beside each other in the texture, and those that a seam between charts parts.

At a seam the texels of either chart reach as far as its border, so a texel of one lies within about a texel's width of one of the other,
though far from it in the texture. Texels of two charts that happen to be packed side by side are no neighbours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.texturing.texels import Texels

Pairs = NDArray[np.int64]

#: Texels beside each other in the texture are neighbours up to so many times the usual distance; texels across a seam up to so many.
STRETCHED, ACROSS = 4.0, 1.5
#: Candidates across the seam for every texel at the rim of a chart, and how far off in the texture (in texels) they are at least.
TRIED, ELSEWHERE = 8, 4
#: Normals across a seam agree at least by this cosine: the other side of a thin sheet is another surface.
SAME_SIDE = 0.5
#: Pairs are mixed in blocks of about this many, which stay together in memory.
BLOCK = 256


def neighbours(texels: Texels, at: NDArray[Any], normal: NDArray[Any]) -> Pairs:
    """Pairs (m, 2) of neighbouring texels, which lie `at` (n, 3) and have the `normal` (n, 3) of any length, in a fixed mixed order."""
    where = np.asarray(at, np.float64)
    beside = _beside(texels)
    apart = np.linalg.norm(where[beside[:, 0]] - where[beside[:, 1]], axis=1)
    width = float(np.median(apart)) if len(apart) else 0.0
    beside = beside[apart <= STRETCHED * width]
    pairs = np.concatenate([beside, _across(texels, where, np.asarray(normal, np.float64), beside, ACROSS * width)])
    blocks = np.array_split(pairs, max(1, len(pairs) // BLOCK))
    np.random.default_rng(0).shuffle(blocks)
    return np.concatenate(blocks) if blocks else pairs


def _beside(texels: Texels) -> Pairs:
    """Pairs (m, 2) that share an edge in the texture."""
    slot = texels.slot.reshape(texels.size, texels.size)
    pairs = []
    for a, b in ((slot[:, :-1], slot[:, 1:]), (slot[:-1], slot[1:])):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]], 1))
    return np.concatenate(pairs)


def _across(texels: Texels, at: NDArray[np.float64], normal: NDArray[np.float64], beside: Pairs, reach: float) -> Pairs:
    """Pairs (m, 2) of texels of different charts nearer to each other than `reach`."""
    rim = np.flatnonzero(np.bincount(beside.ravel(), minlength=len(texels)) < 4)
    if len(rim) < 2 or not reach > 0:
        return np.zeros((0, 2), np.int64)
    distance, found = cKDTree(at[rim]).query(at[rim], k=min(TRIED, len(rim)), distance_upper_bound=reach)
    first, near = np.repeat(rim, distance.shape[1]), np.isfinite(distance.ravel())
    first, second = first[near], rim[found.ravel()[near]]
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    row, column = np.divmod(texels.index, texels.size)
    far = np.maximum(np.abs(row[first] - row[second]), np.abs(column[first] - column[second])) >= ELSEWHERE
    facing = np.einsum("nd,nd->n", unit[first], unit[second]) > SAME_SIDE
    return np.unique(np.sort(np.stack([first, second], 1)[far & facing], axis=1), axis=0)
