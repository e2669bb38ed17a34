"""Quadrics of a textured surface: squared distances in the space of position and texture coordinates.

A point of a wedge is (x, y, z, l·u, l·v), where `l` turns texture units into lengths, so that texture that slides over the surface counts
as an error of shape. A triangle's quadric is the squared distance to its plane in these five dimensions, weighted by its area; a crease
(seam or border) adds, per side, the squared distance to the plane through the edge across the surface, and to its line in the texture.

A quadric is a row of 22 numbers: the upper triangle of A (15), b (5), c, weight; its value at x is xᵀAx + 2 b·x + c.
Garland & Heckbert, *Simplifying surfaces with color and texture using quadric error metrics*, IEEE Visualization 1998.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Dimensions of a wedge's point, and numbers in a quadric.
DIMENSIONS, NUMBERS = 5, 22
#: Rows and columns of the upper triangle of A, in the order in which it is stored.
ROWS, COLUMNS = np.triu_indices(DIMENSIONS)
#: Weight of creases beside that of the surface.
CREASE_WEIGHT = 1.0


def points(position: NDArray[Any], uv: NDArray[Any], wedge_vertex: Ints, scale: float) -> Doubles:
    """Points (w, 5) of the wedges: `position` (v, 3) of their vertices, and `uv` (w, 2) times `scale`."""
    return np.concatenate([np.asarray(position, np.float64)[wedge_vertex], scale * np.asarray(uv, np.float64)], 1)


def triangle_quadrics(point: Doubles, faces: Ints) -> Doubles:
    """Quadrics (w, 22) of the wedges from the triangles `faces` (f, 3) with corners `point` (w, 5); each gets a third of an area."""
    p, q, r = (point[faces[:, k]] for k in range(3))
    e1 = _unit(q - p)
    e2 = r - p
    e2 = _unit(e2 - _dot(e1, e2)[:, None] * e1)
    area = 0.5 * np.linalg.norm(np.cross((q - p)[:, :3], (r - p)[:, :3]), axis=1)
    a = np.eye(DIMENSIONS) - e1[:, :, None] * e1[:, None] - e2[:, :, None] * e2[:, None]
    b = _dot(p, e1)[:, None] * e1 + _dot(p, e2)[:, None] * e2 - p
    c = _dot(p, p) - _dot(p, e1) ** 2 - _dot(p, e2) ** 2
    return _summed(_packed(a, b, c, area / 3, area / 3), faces, len(point))


def crease_quadrics(point: Doubles, edges: Ints, across: Doubles) -> Doubles:
    """Quadrics (w, 22) of both wedges of crease sides `edges` (e, 2); `across` (e, 3) is the normal of the surface beside each."""
    p, q = point[edges[:, 0]], point[edges[:, 1]]
    length = np.linalg.norm((q - p)[:, :3], axis=1)
    normal = np.zeros_like(p)
    normal[:, :3] = _unit(np.cross((q - p)[:, :3], across))
    line = np.zeros_like(p)
    along = _unit((q - p)[:, 3:])
    line[:, 3], line[:, 4] = along[:, 1], -along[:, 0]
    weight = CREASE_WEIGHT * length**2
    total = np.zeros((len(point), NUMBERS))
    for n in (normal, line):
        d = -_dot(n, p)
        total += _summed(_packed(n[:, :, None] * n[:, None], d[:, None] * n, d**2, weight, np.zeros(len(p))), edges, len(point))
    return total


def _packed(a: Doubles, b: Doubles, c: Doubles, factor: Doubles, weight: Doubles) -> Doubles:
    """Quadrics (n, 22) of A, b and c times `factor`, with `weight`."""
    rows = np.concatenate([a[:, ROWS, COLUMNS], b, c[:, None]], 1)
    return np.concatenate([rows * factor[:, None], weight[:, None]], 1)


def _summed(rows: Doubles, owners: Ints, count: int) -> Doubles:
    """Rows (n, 22) added to each of their `owners` (n, k): (count, 22)."""
    out = np.zeros((count, NUMBERS))
    for k in range(owners.shape[1]):
        for column in range(NUMBERS):
            out[:, column] += np.bincount(owners[:, k], rows[:, column], count)
    return out


def _dot(a: Doubles, b: Doubles) -> Doubles:
    return np.asarray(np.einsum("nd,nd->n", a, b))


def _unit(v: Doubles) -> Doubles:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30))
