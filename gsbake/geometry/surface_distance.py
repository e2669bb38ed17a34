"""Exact distances from points to the surface of a triangle mesh.

The hierarchy of boxes is searched depth first, the nearer child first; boxes beyond the best distance so far are left out. The distance to
a triangle is that of Ericson, *Real-Time Collision Detection*, 2005, section 5.1.5. Double precision; each point is independent, so the
result does not depend on the number of threads.
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

Doubles = NDArray[np.float64]

#: Points of one call of the kernel.
CHUNK = 1 << 14


def surface_distances(points: Doubles, vertices: Doubles, faces: NDArray[Any]) -> Doubles:
    """Distance (n,) from each of `points` (n, 3) to the surface of a mesh of `vertices` (v, 3) and `faces` (f, 3); inf without faces."""
    if len(faces) == 0:
        return np.full(len(points), np.inf)
    tree = TriangleTree.over(vertices, faces)
    points = np.ascontiguousarray(points, np.float64)
    out = np.empty(len(points))
    with ThreadPoolExecutor(usable_processors()) as pool:
        chunks = [slice(start, start + CHUNK) for start in range(0, len(points), CHUNK)]
        list(pool.map(lambda chunk: _distances(points[chunk], tree.corners, tree.lower, tree.upper, out[chunk]), chunks))
    return out


@nb.njit(cache=True, nogil=True, forceinline=True)
def _box_distance(x: Any, y: Any, z: Any, lower: Any, upper: Any) -> Any:
    """Squared distance to a box; inf for an empty one, whose lower corner is inf."""
    dx, dy, dz = max(lower[0] - x, 0.0, x - upper[0]), max(lower[1] - y, 0.0, y - upper[1]), max(lower[2] - z, 0.0, z - upper[2])
    return dx * dx + dy * dy + dz * dz


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _triangle_distance(x: Any, y: Any, z: Any, corners: Any) -> Any:
    """Squared distance to a triangle `corners` (3, 3), which may be degenerate; scalars, since small arrays are slow here."""
    ax, ay, az = x - corners[0, 0], y - corners[0, 1], z - corners[0, 2]
    bx, by, bz = x - corners[1, 0], y - corners[1, 1], z - corners[1, 2]
    cx, cy, cz = x - corners[2, 0], y - corners[2, 1], z - corners[2, 2]
    ux, uy, uz = ax - bx, ay - by, az - bz  # first edge
    vx, vy, vz = ax - cx, ay - cy, az - cz  # last edge, reversed
    d1, d2 = ux * ax + uy * ay + uz * az, vx * ax + vy * ay + vz * az
    if d1 <= 0 and d2 <= 0:
        return ax * ax + ay * ay + az * az
    d3, d4 = ux * bx + uy * by + uz * bz, vx * bx + vy * by + vz * bz
    if d3 >= 0 and d4 <= d3:
        return bx * bx + by * by + bz * bz
    d5, d6 = ux * cx + uy * cy + uz * cz, vx * cx + vy * cy + vz * cz
    if d6 >= 0 and d5 <= d6:
        return cx * cx + cy * cy + cz * cz
    wa, wb, wc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    s, t = 0.0, 0.0  # the nearest point is the first corner + s · first edge + t · last edge
    if wc <= 0 and d1 >= 0 and d3 <= 0:
        s = d1 / (d1 - d3)
    elif wb <= 0 and d2 >= 0 and d6 <= 0:
        t = d2 / (d2 - d6)
    elif wa <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1 - t
    else:
        s, t = wb / (wa + wb + wc), wc / (wa + wb + wc)
    rx, ry, rz = ax - s * ux - t * vx, ay - s * uy - t * vy, az - s * uz - t * vz
    return rx * rx + ry * ry + rz * rz


@kernel("f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1]", nogil=True, error_model="numpy")
def _distances(points: Any, corners: Any, lower: Any, upper: Any, out: Any) -> None:
    """Write the distances `out` (n,) of points (n, 3) to triangles (f, 3, 3) in a tree of boxes (m, 3)."""
    leaves = len(lower) // 2
    stack, bounds = np.empty(STACK, np.int64), np.empty(STACK)
    for index in range(len(points)):
        x, y, z = points[index, 0], points[index, 1], points[index, 2]
        best = np.inf
        stack[0], bounds[0], size = 1, 0.0, 1
        while size:
            size -= 1
            node = stack[size]
            if bounds[size] >= best:
                continue
            if node >= leaves:
                first = (node - leaves) * LEAF
                for face in range(first, min(first + LEAF, len(corners))):
                    best = min(best, _triangle_distance(x, y, z, corners[face]))
                continue
            near, far = 2 * node, 2 * node + 1
            near_bound, far_bound = _box_distance(x, y, z, lower[near], upper[near]), _box_distance(x, y, z, lower[far], upper[far])
            if far_bound < near_bound:
                near, far, near_bound, far_bound = far, near, far_bound, near_bound
            stack[size], bounds[size] = far, far_bound
            stack[size + 1], bounds[size + 1] = near, near_bound
            size += 2
        out[index] = np.sqrt(best)
