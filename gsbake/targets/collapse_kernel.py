"""Edge collapses in order of cost, with texture coordinates and seams kept (Numba).

Vertices inside a chart move to the point of least error in position and texture. Vertices of a crease (a seam or a border) collapse along
it onto a neighbour, on all their wedges at once; ends and crossings of creases stay. A collapse is refused that changes the topology (link
condition: Dey et al., *Topology preserving edge contraction*, 1999), turns a triangle over on the surface or in the texture, makes a
sliver, or moves a seam in the texture by more than a tolerance.

Hoppe, *New quadric metric for simplifying meshes with appearance attributes*, IEEE Visualization 1999, for wedges on one vertex.
"""

from __future__ import annotations

import heapq
from typing import Any

import numba as nb
import numpy as np

#: Kinds of vertices: inside a chart, on a crease with two ends, and fixed.
INSIDE, CREASE, FIXED = 0, 1, 2
#: Least cosine between the normals of a triangle before and after, and least quality (4√3 area / sum of squared edges; 1 is equilateral).
MIN_COSINE, MIN_QUALITY = 0.2, 0.02
#: Weight of the pull to the middle of an edge, which makes the least point unique on flat surfaces; share of the quadric's weight.
PULL = 1e-3

_JIT: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}


@nb.njit(**_JIT)
def quadric_value(q: Any, x: Any) -> float:
    """Value of a quadric (22,) at a point (5,)."""
    total, k = q[20], 0
    for i in range(5):
        total += 2 * q[15 + i] * x[i]
        for j in range(i, 5):
            term = q[k] * x[i] * x[j]
            total += term if i == j else 2 * term
            k += 1
    return total


@nb.njit(**_JIT)
def least_point(q: Any, middle: Any, out: Any) -> bool:
    """The point (5,) of least value of a quadric (22,), pulled to `middle`, by Cholesky decomposition; False where there is none."""
    pull = PULL * q[21]
    a = np.zeros((5, 5))
    k = 0
    for i in range(5):
        for j in range(i, 5):
            a[i, j] = a[j, i] = q[k]
            k += 1
        a[i, i] += pull
        out[i] = pull * middle[i] - q[15 + i]
    for i in range(5):
        for j in range(i + 1):
            total = a[i, j]
            for m in range(j):
                total -= a[i, m] * a[j, m]
            if i == j:
                if not total > 0:
                    return False
                a[i, i] = np.sqrt(total)
            else:
                a[i, j] = total / a[j, j]
    for i in range(5):
        for m in range(i):
            out[i] -= a[i, m] * out[m]
        out[i] /= a[i, i]
    for i in range(4, -1, -1):
        for m in range(i + 1, 5):
            out[i] -= a[m, i] * out[m]
        out[i] /= a[i, i]
    return True


@nb.njit(**_JIT)
def _edge_faces(a: int, b: int, head: Any, following: Any, faces: Any, vertex: Any, alive: Any, found: Any) -> int:
    """Number of live triangles with vertices a and b; the first two as rows (wedge at a, wedge at b, vertex opposite) of `found`."""
    count = 0
    corner = head[a]
    while corner >= 0:
        face, k = corner // 3, corner % 3
        if alive[face]:
            one, two = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            if vertex[one] == b or vertex[two] == b:
                if count < 2:
                    found[count, 0] = faces[face, k]
                    found[count, 1] = one if vertex[one] == b else two
                    found[count, 2] = vertex[two] if vertex[one] == b else vertex[one]
                count += 1
        corner = following[corner]
    return count


@nb.njit(**_JIT)
def _linked(a: int, b: int, ring: int, head: Any, following: Any, faces: Any, vertex: Any, alive: Any, mark: Any) -> int:
    """Number of vertices that are neighbours of both a and b; `ring` is a new value for `mark`."""
    corner = head[a]
    while corner >= 0:
        face = corner // 3
        if alive[face]:
            for k in range(3):
                mark[vertex[faces[face, k]]] = ring
        corner = following[corner]
    mark[a] = mark[b] = ring - 1
    count = 0
    corner = head[b]
    while corner >= 0:
        face = corner // 3
        if alive[face]:
            for k in range(3):
                v = vertex[faces[face, k]]
                if mark[v] == ring:
                    mark[v] = ring - 1
                    count += 1
        corner = following[corner]
    return count


@nb.njit(**_JIT)
def _triangle(p: Any, q: Any, r: Any, normal: Any) -> float:
    """Quality of a triangle; `normal` (3,) becomes twice the area times the unit normal."""
    ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    cx, cy, cz = bx - ax, by - ay, bz - az
    normal[0], normal[1], normal[2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    edges = ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz + cx * cx + cy * cy + cz * cz
    area = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return 2 * np.sqrt(3.0) * area / edges if edges > 0 else 0.0


@nb.njit(**_JIT)
def _uv_area(p: Any, q: Any, r: Any) -> float:
    """Twice the signed area of a triangle in the texture."""
    return (q[3] - p[3]) * (r[4] - p[4]) - (r[3] - p[3]) * (q[4] - p[4])


@nb.njit(**_JIT)
def _fits(
    moved: int, other: int, to: Any, wedge_from: Any, head: Any, following: Any, faces: Any, vertex: Any, alive: Any, point: Any
) -> bool:
    """Whether the triangles around `moved` (but not `other`) keep their side and shape with its wedges `wedge_from` (2,) at `to` (2, 5)."""
    old, new = np.empty(3), np.empty(3)
    corner = head[moved]
    while corner >= 0:
        face, k = corner // 3, corner % 3
        following_corner = following[corner]
        if alive[face]:
            w, one, two = faces[face, k], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            if vertex[one] != other and vertex[two] != other:
                if w == wedge_from[0]:
                    target = to[0]
                elif w == wedge_from[1]:
                    target = to[1]
                else:
                    return False
                was = _triangle(point[w], point[one], point[two], old)
                now = _triangle(target, point[one], point[two], new)
                if now < MIN_QUALITY and now < was:
                    return False
                dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
                lengths = np.sqrt((old[0] ** 2 + old[1] ** 2 + old[2] ** 2) * (new[0] ** 2 + new[1] ** 2 + new[2] ** 2))
                if dot < MIN_COSINE * lengths or lengths == 0:
                    return False
                before, after = _uv_area(point[w], point[one], point[two]), _uv_area(target, point[one], point[two])
                if not before * after > 1e-3 * before * before:
                    return False
        corner = following_corner
    return True


@nb.njit(**_JIT)
def _segment_distance(p: Any, a: Any, b: Any) -> float:
    """Distance in the texture of a point from a segment."""
    dx, dy = b[3] - a[3], b[4] - a[4]
    px, py = p[3] - a[3], p[4] - a[4]
    length = dx * dx + dy * dy
    t = min(1.0, max(0.0, (px * dx + py * dy) / length)) if length > 0 else 0.0
    return np.sqrt((px - t * dx) ** 2 + (py - t * dy) ** 2)


@nb.njit(**_JIT)
def _previous_on_crease(a: int, b: int, w: int, head: Any, following: Any, faces: Any, vertex: Any, alive: Any, found: Any) -> int:
    """The wedge at the other end of the second crease edge of vertex a, beside wedge w; -1: none. `found` is scratch (2, 3)."""
    corner = head[a]
    while corner >= 0:
        face, k = corner // 3, corner % 3
        if alive[face] and faces[face, k] == w:
            for step in (1, 2):
                far = faces[face, (k + step) % 3]
                if vertex[far] != b:
                    count = _edge_faces(a, vertex[far], head, following, faces, vertex, alive, found)
                    if count == 1 or (count == 2 and (found[0, 0] != found[1, 0] or found[0, 1] != found[1, 1])):
                        return far
        corner = following[corner]
    return -1


@nb.njit(**_JIT)
def _plan(
    a: int, b: int, ring: int, kind: Any, quadric: Any, head: Any, following: Any, faces: Any, vertex: Any, alive: Any, point: Any,
    mark: Any, drift: Any, tolerance: float, to: Any, wedges: Any,
) -> tuple[float, float]:
    """Cost of collapsing vertex a onto b, inf where it is refused, and the accumulated drift of the seam.

    `wedges` (2, 2) becomes the pairs (wedge of a, wedge of b), `to` (2, 5) where b's wedges go: the least point where both are inside.
    """  # fmt: skip
    found = np.empty((2, 3), np.int64)
    none = np.inf
    if kind[a] == FIXED:
        return none, 0.0
    count = _edge_faces(a, b, head, following, faces, vertex, alive, found)
    if count == 0 or count > 2:
        return none, 0.0
    crease = count == 1 or found[0, 0] != found[1, 0] or found[0, 1] != found[1, 1]
    if (kind[a] == CREASE) != crease:
        return none, 0.0
    if _linked(a, b, ring, head, following, faces, vertex, alive, mark) != count:
        return none, 0.0
    sides = 1 if count == 1 or (found[0, 0] == found[1, 0] and found[0, 1] == found[1, 1]) else 2
    if sides == 2 and found[0, 0] == found[1, 0]:  # the seam ends at a
        return none, 0.0
    wedges[:] = -1
    for side in range(sides):
        wedges[side, 0], wedges[side, 1] = found[side, 0], found[side, 1]
        to[side] = point[found[side, 1]]
    cost, weight, moved = 0.0, 0.0, 0.0
    if kind[a] == INSIDE and kind[b] == INSIDE:
        merged = quadric[wedges[0, 0]] + quadric[wedges[0, 1]]
        middle = 0.5 * (point[wedges[0, 0]] + point[wedges[0, 1]])
        best = np.empty(5)
        if not least_point(merged, middle, best):
            best[:] = middle
        cost, weight = quadric_value(merged, best), merged[21]
        to[0] = best
        if not _fits(b, a, to, wedges[:, 1], head, following, faces, vertex, alive, point):
            return none, 0.0
    else:
        for side in range(sides):
            merged = quadric[wedges[side, 0]] + quadric[wedges[side, 1]]
            cost += quadric_value(merged, to[side])
            weight += merged[21]
    if not _fits(a, b, to, wedges[:, 0], head, following, faces, vertex, alive, point):
        return none, 0.0
    if kind[a] == CREASE:
        for side in range(sides):
            behind = _previous_on_crease(a, b, wedges[side, 0], head, following, faces, vertex, alive, found)
            if behind < 0:
                return none, 0.0
            moved = max(moved, _segment_distance(point[wedges[side, 0]], point[behind], to[side]))
        moved += max(drift[a], drift[b] if kind[b] == CREASE else 0.0)
        if moved > tolerance:
            return none, 0.0
    return max(cost, 0.0) / max(weight, 1e-300), moved


@nb.njit(**_JIT)
def collapse(
    point: Any, vertex: Any, faces: Any, kind: Any, quadric: Any, alive: Any, target: int, max_cost: float, tolerance: float
) -> tuple[int, float]:
    """Collapse edges in place until `target` triangles are alive or the least cost exceeds `max_cost`; (triangles, largest cost).

    `point` (w, 5) of the wedges, their `vertex` (w,), `faces` (f, 3) of wedges, `kind` (v,), `quadric` (w, 22), `alive` (f,) True.
    `tolerance` is the largest drift of a seam in the units of the last two dimensions.
    """
    count = len(kind)
    head, following = np.full(count, -1, np.int64), np.full(faces.size, -1, np.int64)
    for face in range(len(faces)):
        for k in range(3):
            v = vertex[faces[face, k]]
            following[3 * face + k] = head[v]
            head[v] = 3 * face + k
    mark, version, drift = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count)
    to, wedges = np.empty((2, 5)), np.empty((2, 2), np.int64)
    ring = 2
    max_cost = min(max_cost, 1e300)  # inf is a refusal
    heap = [(0.0, 0, 0, 0, 0)]
    heap.pop()
    for face in range(len(faces)):
        for k in range(3):
            a, b = vertex[faces[face, k]], vertex[faces[face, (k + 1) % 3]]
            for start, end in ((a, b), (b, a)):
                ring += 2
                cost, _ = _plan(
                    start, end, ring, kind, quadric, head, following, faces, vertex, alive, point, mark, drift, tolerance, to, wedges
                )
                if cost <= max_cost:
                    heap.append((cost, start, end, 0, 0))
    heapq.heapify(heap)
    living, largest = len(faces), 0.0
    while living > target and len(heap):
        cost, a, b, version_a, version_b = heapq.heappop(heap)
        if version[a] != version_a or version[b] != version_b or head[a] < 0:
            continue
        ring += 2
        now, moved = _plan(a, b, ring, kind, quadric, head, following, faces, vertex, alive, point, mark, drift, tolerance, to, wedges)
        if not now <= max_cost:
            continue
        if now > cost * (1 + 1e-9) + 1e-300:  # a neighbour has changed it since
            heapq.heappush(heap, (now, a, b, version_a, version_b))
            continue
        largest = max(largest, now)
        for side in range(2):
            if wedges[side, 0] >= 0:
                point[wedges[side, 1]] = to[side]
                quadric[wedges[side, 1]] += quadric[wedges[side, 0]]
        if kind[a] == CREASE:
            drift[b] = max(drift[b], moved)
        corner = head[a]
        while corner >= 0:
            after = following[corner]
            face, k = corner // 3, corner % 3
            if alive[face]:
                if vertex[faces[face, (k + 1) % 3]] == b or vertex[faces[face, (k + 2) % 3]] == b:
                    alive[face] = False
                    living -= 1
                else:
                    faces[face, k] = wedges[0, 1] if faces[face, k] == wedges[0, 0] else wedges[1, 1]
                    following[corner] = head[b]
                    head[b] = corner
            corner = after
        head[a] = -1
        previous, corner = -1, head[b]  # unlink what is dead
        while corner >= 0:
            if alive[corner // 3]:
                previous = corner
            elif previous < 0:
                head[b] = following[corner]
            else:
                following[previous] = following[corner]
            corner = following[corner]
        version[b] += 1
        corner = head[b]
        while corner >= 0:
            face = corner // 3
            if alive[face]:
                for k in range(3):
                    v = vertex[faces[face, k]]
                    if v != b:
                        for start, end in ((v, b), (b, v)):
                            ring += 2
                            cost, _ = _plan(
                                start, end, ring, kind, quadric, head, following, faces, vertex, alive, point, mark, drift, tolerance,
                                to, wedges,
                            )  # fmt: skip
                            if cost <= max_cost:
                                heapq.heappush(heap, (cost, start, end, version[start], version[end]))
            corner = following[corner]
    return living, largest
