"""Averages over neighbouring texels that look alike: a filter over the surface that stops at the edges of what the photos show.

The average u of values f is the one with (1 + L) u = f, where L is the Laplacian of the graph of neighbouring texels, across seams
included, whose edges conduct the less the more colour changes along them. Two by two texels are one node; the system is factored once and
solved for every f.

Farbman, Fattal, Lischinski & Szeliski, *Edge-preserving decompositions for multi-scale tone and detail manipulation*, SIGGRAPH 2008
(weighted least squares).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.texturing.texels import Texels

#: Texels along a surface of one colour over which neighbours count, and the change of colour (sRGB, all channels together) from texel to
#: texel that makes one texel's way as long as all that.
REACH, DIFFERENT = 60.0, 0.3
#: The colours compared are averages over about this many texels: a fine pattern is one thing.
PATTERN = 2.0
#: Variance, in square texels, that one step of averaging a texel with its four neighbours adds along either axis of the texture.
STEP = 0.4
#: Edge of a node of the graph in texels.
NODE = 2


class Alike:
    """The filter of `texels` whose linear colours (n, 3) are `shown` and of which `pairs` (m, 2) are neighbours."""

    def __init__(self, texels: Texels, pairs: NDArray[np.int64], shown: NDArray[Any]) -> None:
        colour = _blurred(encode(np.clip(np.asarray(shown, np.float32), 0, 1)), pairs)
        row, column = np.divmod(texels.index, texels.size)
        self._node = np.unique(row // NODE * texels.size + column // NODE, return_inverse=True)[1]
        size = np.bincount(self._node)
        colour = np.stack([np.bincount(self._node, c) for c in colour.T], 1) / size[:, None]
        edge = np.sort(self._node[pairs], axis=1)
        edge = np.unique(edge[edge[:, 0] != edge[:, 1]], axis=0)
        change = np.abs(colour[edge[:, 0]] - colour[edge[:, 1]]).sum(1) / NODE
        conducted = (REACH / (1 + REACH / DIFFERENT * change)) ** 2
        graph = _symmetric(edge, conducted, len(size))
        flow = scipy.sparse.diags(np.asarray(graph.sum(1)).ravel() + size)
        # The matrix is symmetric and its diagonal outweighs its rows: no pivots are needed.
        self._solved = scipy.sparse.linalg.splu(
            (flow - graph).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def __call__(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """`values` (n,) averaged over the texels around each that look alike."""
        return np.asarray(self._solved.solve(np.bincount(self._node, np.asarray(values, np.float64)))[self._node])


def _blurred(values: NDArray[np.float32], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """`values` (n, c) averaged over about `PATTERN` texels of the surface."""
    beside = _symmetric(pairs, np.ones(len(pairs)), len(values))
    count = 1 + np.asarray(beside.sum(1)).ravel()
    out = np.asarray(values, np.float64)
    for _ in range(round(PATTERN**2 / STEP)):
        out = (out + beside @ out) / count[:, None]
    return out


def _symmetric(pairs: NDArray[np.int64], weight: NDArray[np.float64], n: int) -> scipy.sparse.csr_matrix:
    """The matrix (n, n) with `weight` (m,) at the `pairs` (m, 2), both ways."""
    one = scipy.sparse.csr_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return one + one.T
