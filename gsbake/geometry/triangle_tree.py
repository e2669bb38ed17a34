"""A bounding volume hierarchy over the triangles of a mesh, in Morton order, four to a leaf, for the compiled searches of this folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

#: Triangles in a leaf.
LEAF = 4
#: Bits per axis of a Morton code.
MORTON_BITS = 20
#: Capacity of a depth-first search's stack: one entry a level and one more; 2⁶⁰ leaves.
STACK = 64


@dataclass(frozen=True)
class TriangleTree:
    """A complete binary tree of boxes (m, 3) from `lower` to `upper`: node 1 is the root, 2i and 2i+1 the children of i, the last half
    leaves of `LEAF` triangles each. `corners` (f, 3, 3) of the triangles in the order of the leaves, `order` (f,) their faces."""

    order: NDArray[np.int64]
    corners: Doubles
    lower: Doubles
    upper: Doubles

    @classmethod
    def over(cls, vertices: Doubles, faces: NDArray[Any]) -> TriangleTree:
        """The tree over `vertices` (v, 3) and at least one of `faces` (f, 3)."""
        corners = np.asarray(vertices, np.float64)[faces]
        order = _morton_order(corners.mean(1))
        corners = np.ascontiguousarray(corners[order])
        return cls(order, corners, *_boxes(corners))


def _morton_order(points: Doubles) -> NDArray[np.int64]:
    """Order (n,) of points along a Z-shaped curve."""
    lower = points.min(0)
    extent = max(float((points.max(0) - lower).max()), np.finfo(np.float64).tiny)
    cells = ((points - lower) / extent * (2**MORTON_BITS - 1)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _boxes(corners: Doubles) -> tuple[Doubles, Doubles]:
    """Corners (m, 3) of the boxes of a complete binary tree: node 1 is the root, 2i and 2i+1 the children of i, the last half leaves."""
    count = 1 << max(0, int(np.ceil(np.log2(-(-len(corners) // LEAF)))))
    padded_lower = np.full((count * LEAF, 3), np.inf)
    padded_upper = np.full((count * LEAF, 3), -np.inf)
    padded_lower[: len(corners)], padded_upper[: len(corners)] = corners.min(1), corners.max(1)
    lower, upper = np.full((2 * count, 3), np.inf), np.full((2 * count, 3), -np.inf)
    lower[count:] = padded_lower.reshape(count, LEAF, 3).min(1)
    upper[count:] = padded_upper.reshape(count, LEAF, 3).max(1)
    while count > 1:
        count //= 2
        lower[count : 2 * count] = lower[2 * count : 4 * count].reshape(count, 2, 3).min(1)
        upper[count : 2 * count] = upper[2 * count : 4 * count].reshape(count, 2, 3).max(1)
    return lower, upper
