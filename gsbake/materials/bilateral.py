"""Edge-aware filter on the surface: averages of texel values that stop at edges of the texture's appearance.

The average u of values f solves (1 + L) u = f, where L is the Laplacian of the graph of neighbouring texels, across seams included; edge
weights fall with the change of appearance, such as colour. Two by two texels are one node; the system is factored once and solved for
every f.

Farbman, Fattal, Lischinski & Szeliski, *Edge-preserving decompositions for multi-scale tone and detail manipulation*, SIGGRAPH 2008
(weighted least squares).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.texturing.texels import Texels

#: Change of colour (sRGB, sum of channels) between adjacent texels over which a wide and a near neighbourhood extend, and the factor on a
#: change of roughness beside it.
WIDE_SCALE, NEAR_SCALE, ROUGHNESS_FACTOR = 0.3, 0.15, 0.5
#: Radius of the filter on a uniform surface, in texels.
FILTER_RADIUS = 60.0
#: Width in texels of the smoothing of appearance before they are compared: fine patterns are one material.
PREFILTER_WIDTH = 2.0
#: Variance, in square texels, that averaging a texel with its four neighbours adds along either axis.
AVERAGING_VARIANCE = 0.4
#: Edge of a graph node in texels.
NODE_SIZE = 2


class EdgeAwareFilter:
    """The filter on `texels` with an `appearance` (n, c) of any channels and neighbouring `pairs` (m, 2).

    A change by `scale`, summed over channels, between adjacent texels is as far as the whole radius.
    """

    def __init__(self, texels: Texels, pairs: NDArray[np.int64], appearance: NDArray[np.float32], scale: float) -> None:
        smooth = _prefiltered(appearance, pairs)
        row, column = np.divmod(texels.index, texels.size)
        self._node = np.unique(row // NODE_SIZE * texels.size + column // NODE_SIZE, return_inverse=True)[1]
        size = np.bincount(self._node)
        smooth = np.stack([np.bincount(self._node, c) for c in smooth.T], 1) / size[:, None]
        edge = np.sort(self._node[pairs], axis=1)
        edge = np.unique(edge[edge[:, 0] != edge[:, 1]], axis=0)
        change = np.abs(smooth[edge[:, 0]] - smooth[edge[:, 1]]).sum(1) / NODE_SIZE
        weight = (FILTER_RADIUS / (1 + FILTER_RADIUS / scale * change)) ** 2
        graph = _symmetric(edge, weight, len(size))
        degree = scipy.sparse.diags(np.asarray(graph.sum(1)).ravel() + size)
        # The matrix is symmetric and diagonally dominant: no pivoting is needed.
        self._factor = scipy.sparse.linalg.splu(
            (degree - graph).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def __call__(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """`values` (n,) averaged over the neighbourhood of similar appearance of each texel."""
        return np.asarray(self._factor.solve(np.bincount(self._node, np.asarray(values, np.float64)))[self._node])


class Neighbourhoods:
    """The neighbourhoods of texels that decide together, on `texels` with neighbouring `pairs` (m, 2) and the photos' linear colours
    `photographed` (n, 3)."""

    def __init__(self, texels: Texels, pairs: NDArray[np.int64], photographed: NDArray[Any]) -> None:
        self._texels, self._pairs, self._photographed = texels, pairs, photographed

    @cached_property
    def wide(self) -> EdgeAwareFilter:
        """The filter over texels of similar colour in photos; built on first use."""
        colour = encode(np.clip(np.asarray(self._photographed, np.float32), 0, 1))
        return EdgeAwareFilter(self._texels, self._pairs, colour, WIDE_SCALE)

    def near(self, base_color: NDArray[np.float32], roughness: NDArray[np.float32]) -> EdgeAwareFilter:
        """The filter over texels of nearly the same material: linear `base_color` (n, 3) and `roughness` (n,)."""
        material = np.column_stack([encode(base_color), ROUGHNESS_FACTOR * roughness])
        return EdgeAwareFilter(self._texels, self._pairs, material, NEAR_SCALE)


def _prefiltered(values: NDArray[np.float32], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """`values` (n, c) smoothed over about `PREFILTER_WIDTH` texels of the surface."""
    adjacency = _symmetric(pairs, np.ones(len(pairs)), len(values))
    count = 1 + np.asarray(adjacency.sum(1)).ravel()
    out = np.asarray(values, np.float64)
    for _ in range(round(PREFILTER_WIDTH**2 / AVERAGING_VARIANCE)):
        out = (out + adjacency @ out) / count[:, None]
    return out


def _symmetric(pairs: NDArray[np.int64], weight: NDArray[np.float64], n: int) -> scipy.sparse.csr_matrix:
    """The symmetric matrix (n, n) with `weight` (m,) at the `pairs` (m, 2)."""
    upper = scipy.sparse.csr_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return upper + upper.T
