"""Faces of a triangle mesh that cross other faces of it.

Two triangles cross where an edge of one passes through the other: its ends lie on different sides of the plane, and all edges are seen
from it with the same orientation (signed volumes: Segura & Feito, *Algorithms to test ray-triangle intersection*, WSCG 2001). Of faces
that share a corner, only the edges opposite to it can cross the other face; faces that share an edge meet nowhere else unless they are
folded onto each other. Faces that overlap in one plane do not count. Double precision; the result does not depend on the number of threads.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.triangle_tree import LEAF, STACK, TriangleTree
from gsbake.kernels.declaration import kernel
from gsbake.system.limits import usable_processors

#: Faces of one call of the kernel.
CHUNK = 1 << 13


def self_intersecting_faces(
    vertices: NDArray[np.float64], faces: NDArray[Any], among: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Which faces (f,) cross another one, of a mesh of `vertices` (v, 3) and `faces` (f, 3).

    `among` (f,): only crossings with at least one of these faces are looked for.
    """
    found = np.zeros(len(faces), np.uint8)
    chosen = np.arange(len(faces)) if among is None else np.flatnonzero(among)
    if len(chosen):
        tree = TriangleTree.over(vertices, faces[chosen])
        corners = np.ascontiguousarray(np.asarray(vertices, np.float64)[faces])
        names, leaves = np.ascontiguousarray(faces, np.int64), chosen[tree.order]
        with ThreadPoolExecutor(usable_processors()) as pool:
            starts = range(0, len(faces), CHUNK)
            list(pool.map(lambda start: _cross(start, start + CHUNK, names, corners, leaves, tree.lower, tree.upper, found), starts))
    return found > 0


@nb.njit(cache=True, nogil=True, forceinline=True)
def _volume(corners: Any, i: Any, a: Any, b: Any, j: Any, c: Any, k: Any, d: Any) -> Any:
    """Six times the signed volume between corners a and b of face i, c of face j, and d of face k."""
    x, y, z = corners[i, a, 0], corners[i, a, 1], corners[i, a, 2]
    bx, by, bz = corners[i, b, 0] - x, corners[i, b, 1] - y, corners[i, b, 2] - z
    cx, cy, cz = corners[j, c, 0] - x, corners[j, c, 1] - y, corners[j, c, 2] - z
    dx, dy, dz = corners[k, d, 0] - x, corners[k, d, 1] - y, corners[k, d, 2] - z
    return bx * (cy * dz - cz * dy) + by * (cz * dx - cx * dz) + bz * (cx * dy - cy * dx)


@nb.njit(cache=True, nogil=True, forceinline=True)
def _edge_passes(corners: Any, names: Any, i: Any, j: Any) -> Any:
    """Whether an edge of face i at whose ends face j has no corner passes through face j."""
    for one in range(3):
        two = (one + 1) % 3
        shared = False
        for k in range(3):
            shared |= names[i, one] == names[j, k] or names[i, two] == names[j, k]
        if shared or _volume(corners, j, 0, 1, j, 2, i, one) * _volume(corners, j, 0, 1, j, 2, i, two) >= 0:
            continue
        u, v = _volume(corners, i, one, two, j, 0, j, 1), _volume(corners, i, one, two, j, 1, j, 2)
        w = _volume(corners, i, one, two, j, 2, j, 0)
        if (u >= 0 and v >= 0 and w >= 0) or (u <= 0 and v <= 0 and w <= 0):
            return True
    return False


@nb.njit(cache=True, nogil=True, forceinline=True)
def _apart(corners: Any, j: Any, low: Any, high: Any) -> Any:
    """Whether the box of face j lies beside another box."""
    for k in range(3):
        a, b, c = corners[j, 0, k], corners[j, 1, k], corners[j, 2, k]
        if min(a, b, c) > high[k] or max(a, b, c) < low[k]:
            return True
    return False


@kernel("i8, i8, i8[:, ::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8[:, ::1], u1[::1]", nogil=True, error_model="numpy")
def _cross(start: Any, end: Any, names: Any, corners: Any, leaves: Any, lower: Any, upper: Any, found: Any) -> None:
    """Mark in `found` (f,) the faces from `start` to `end` that cross one of the `leaves` (m,) of a tree, and those; all threads write the
    same value. `names` (f, 3) and `corners` (f, 3, 3) are of all faces."""
    half = len(lower) // 2
    stack = np.empty(STACK, np.int64)
    low, high = np.empty(3), np.empty(3)
    for i in range(start, min(end, len(names))):
        for k in range(3):
            low[k] = min(corners[i, 0, k], corners[i, 1, k], corners[i, 2, k])
            high[k] = max(corners[i, 0, k], corners[i, 1, k], corners[i, 2, k])
        stack[0], size = 1, 1
        while size:
            size -= 1
            node = stack[size]
            if (
                lower[node, 0] > high[0] or upper[node, 0] < low[0] or lower[node, 1] > high[1] or upper[node, 1] < low[1]
                or lower[node, 2] > high[2] or upper[node, 2] < low[2]
            ):  # fmt: skip
                continue
            if node < half:
                stack[size], stack[size + 1] = 2 * node, 2 * node + 1
                size += 2
                continue
            first = (node - half) * LEAF
            for leaf in range(first, min(first + LEAF, len(leaves))):
                j = leaves[leaf]
                if j == i or (found[i] and found[j]) or _apart(corners, j, low, high):
                    continue
                if _edge_passes(corners, names, i, j) or _edge_passes(corners, names, j, i):
                    found[i], found[j] = 1, 1
