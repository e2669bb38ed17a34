"""Repair of a mesh's topology: duplicate and degenerate faces, non-manifold edges and vertices, holes.

Holes are triangulated with least area by dynamic programming (Barequet & Sharir, *Filling gaps in the boundary of a polyhedron*, CAGD
1995). Non-manifold edges lose faces with a free edge, else their smallest; non-manifold vertices are split, one vertex per fan of faces
(Guéziec et al., *Cutting and stitching*, IEEE TVCG 2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from gsbake.meshing.cleanup import Faces, Vertices, edge_keys, remove_unused_vertices, topology

#: How far the copies of a split vertex move apart: share of the way to the mean of their fan's other vertices. Programs that merge vertices
#: at equal positions would undo the split.
SEPARATION = 0.01


def repair(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Remove duplicate vertices, duplicate and degenerate faces, and non-manifold edges and vertices; the result may have new holes."""
    vertices, merged = _merge_vertices(vertices)
    faces = _remove_degenerate_faces(vertices, merged[faces])
    faces = _remove_duplicate_faces(faces)
    faces = _remove_non_manifold_faces(vertices, faces)
    return split_non_manifold_vertices(*remove_unused_vertices(vertices, faces))


@dataclass(frozen=True)
class Repaired:
    """A mesh of another program after `repair_foreign`: `vertices` (v, 3) and `faces` (f, 3), and what was wrong with it.

    `joined` vertices at the place of others, `double` faces, faces `without_area`, edges with more than two faces (`non_manifold`), faces
    `cut` there and `filled` in the holes that this left.
    """

    vertices: Vertices
    faces: Faces
    joined: int
    without_area: int
    double: int
    non_manifold: int = 0
    cut: int = 0
    filled: int = 0

    @property
    def faults(self) -> str:
        """What was left out and added, for a person; empty where nothing was but vertices at one place."""
        parts = []
        if self.without_area:
            parts.append(f"{self.without_area} faces without area")
        if self.double:
            parts.append(f"{self.double} double faces")
        if self.cut:
            parts.append(f"{self.cut} faces at {self.non_manifold} edges that had more than two (holes closed with {self.filled})")
        return ", ".join(parts)


def repair_foreign(vertices: Vertices, faces: Faces, max_hole_edges: int) -> Repaired:
    """What `repair` does, only where it is needed, and with the holes of at most `max_hole_edges` edges closed that it leaves.

    Openings of the mesh stay open. A mesh without faults is returned as it is.
    """
    merged_vertices, merged = _merge_vertices(vertices)
    joined = len(vertices) - len(merged_vertices)
    clean = _remove_degenerate_faces(merged_vertices, merged[faces])
    single = _remove_duplicate_faces(clean)
    border, non_manifold = _edges_of(merged_vertices, single)
    without_area, double = len(faces) - len(clean), len(clean) - len(single)
    if not non_manifold:
        mesh = remove_unused_vertices(merged_vertices, single) if joined or without_area or double else (vertices, faces)
        return Repaired(*mesh, joined, without_area, double)
    manifold = _remove_non_manifold_faces(merged_vertices, single)
    # Several holes may meet at a vertex; once it is split, each has its own.
    parted_vertices, parted = split_non_manifold_vertices(merged_vertices, manifold)
    origin = np.zeros(len(parted_vertices), np.int64)
    origin[parted] = manifold
    holes = _boundary(parted_vertices, parted)
    holes = holes[~np.isin(np.sort(origin[holes], axis=1) @ np.array([len(merged_vertices), 1]), border)]
    used = np.unique(edge_keys(parted_vertices, parted))
    patches = [fill_hole(parted_vertices, loop, used) for loop in boundary_loops(holes) if len(loop) <= max_hole_edges]
    whole = np.concatenate([parted, *patches]).astype(np.int32)
    final = remove_unused_vertices(parted_vertices, whole)
    cut, filled = len(single) - len(manifold), len(whole) - len(parted)
    return Repaired(*final, joined, without_area, double, non_manifold, cut, filled)


def _edges_of(vertices: Vertices, faces: Faces) -> tuple[NDArray[np.int64], int]:
    """Keys of the edges with one face, and the number of those with more than two."""
    keys, counts = np.unique(edge_keys(vertices, faces), return_counts=True)
    return keys[counts == 1], int((counts > 2).sum())


def close_holes(vertices: Vertices, faces: Faces, max_edges: int) -> tuple[Vertices, Faces]:
    """Triangulate every hole of at most `max_edges` boundary edges.

    A hole stays open where each triangulation would put a third face on an edge.
    """
    if topology(vertices, faces).border_edges == 0:
        return vertices, faces
    vertices, faces = split_non_manifold_vertices(vertices, faces)
    edges = np.unique(edge_keys(vertices, faces))
    patches = [fill_hole(vertices, loop, edges) for loop in boundary_loops(_boundary(vertices, faces)) if len(loop) <= max_edges]
    return vertices, np.concatenate([faces, *patches]).astype(np.int32)


def split_non_manifold_vertices(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Give each fan of faces around a vertex a vertex of its own, slightly towards its faces.

    Faces are adjacent across edges of two faces of equal orientation.
    """
    corners, count = faces.ravel(), 3 * len(faces)
    ends = faces[:, [1, 2, 0]].ravel()
    following = np.arange(count).reshape(-1, 3)[:, [1, 2, 0]].ravel()  # index of the corner after each corner
    keys = edge_keys(vertices, faces)
    order = np.argsort(keys, kind="stable")
    _, first, counts = np.unique(keys[order], return_index=True, return_counts=True)
    left, right = order[first[counts == 2]], order[first[counts == 2] + 1]
    opposite = (corners[left] == ends[right]) & (corners[right] == ends[left])
    left, right = left[opposite], right[opposite]
    rows, columns = np.concatenate([left, following[left]]), np.concatenate([following[right], right])
    same = sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    fans, fan = connected_components(same, directed=False)
    if fans == len(np.unique(corners)):
        return vertices, faces
    vertex = np.empty(fans, np.int64)
    vertex[fan] = corners
    # The first fan of each vertex keeps its place; the others follow at the end.
    by_vertex = np.argsort(vertex, kind="stable")
    further = np.zeros(fans, np.bool_)
    further[by_vertex[1:]] = vertex[by_vertex[1:]] == vertex[by_vertex[:-1]]
    index = vertex.copy()
    index[further] = len(vertices) + np.arange(further.sum())
    out = np.concatenate([vertices, vertices[vertex[further]]])
    others = vertices[ends] + vertices[faces[:, [2, 0, 1]].ravel()]
    mean = np.stack([np.bincount(fan, others[:, axis], fans) for axis in range(3)], 1) / (2 * np.bincount(fan, minlength=fans))[:, None]
    parted = np.isin(vertex, vertex[further])
    out[index[parted]] += SEPARATION * (mean[parted] - vertices[vertex[parted]])
    return out, index[fan].reshape(-1, 3).astype(np.int32)


def _merge_vertices(vertices: Vertices) -> tuple[Vertices, NDArray[np.int32]]:
    """Vertices without duplicates, in the old order, and the new index of each old one."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    kept = np.sort(first)
    return vertices[kept], np.searchsorted(kept, first[inverse.ravel()]).astype(np.int32)


def _remove_degenerate_faces(vertices: Vertices, faces: Faces) -> Faces:
    """Faces with three different corners and an area."""
    return faces[_doubled_areas(vertices, faces) > 0]


def _remove_duplicate_faces(faces: Faces) -> Faces:
    """One of equal faces; two faces on the same corners that point in opposite directions cancel each other."""
    if len(faces) == 0:
        return faces
    _, inverse = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    rotated = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    sign = np.where(rotated[:, 1] < rotated[:, 2], 1, -1)
    total = np.bincount(inverse, sign).astype(np.int64)
    candidates = np.flatnonzero(sign * total[inverse] > 0)
    _, first = np.unique(inverse[candidates], return_index=True)
    return faces[np.sort(candidates[first])]


def _remove_non_manifold_faces(vertices: Vertices, faces: Faces) -> Faces:
    """Remove a face of each edge with more than two faces, of the direction that has more of them, until there is none.

    It is one with a free edge, whose loss opens nothing, else the smallest. Edges with very many lose an eighth of them at once, else
    thousands of faces at one edge would take as many rounds.
    """
    while len(faces):
        keys = edge_keys(vertices, faces)
        _, edge, counts = np.unique(keys, return_inverse=True, return_counts=True)
        edge = edge.ravel()
        direction = np.where(faces < faces[:, [1, 2, 0]], 1, -1).ravel()
        excess = (counts[edge] > 2) & (direction * np.bincount(edge, direction)[edge] >= 0)
        if not excess.any():
            break
        closed = np.all(counts[edge].reshape(-1, 3) > 1, axis=1)
        face, edge = np.repeat(np.arange(len(faces)), 3)[excess], edge[excess]
        order = np.lexsort((face, _doubled_areas(vertices, faces)[face], closed[face], edge))
        _, first, place = np.unique(edge[order], return_index=True, return_inverse=True)
        worst = np.arange(len(order)) - first[place] < np.maximum(counts[edge[order]] // 8, 1)
        keep = np.ones(len(faces), np.bool_)
        keep[face[order[worst]]] = False
        faces = faces[keep]
    return faces


def _doubled_areas(vertices: Vertices, faces: Faces) -> NDArray[np.float64]:
    corners = vertices[faces]
    return np.asarray(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1), np.float64)


def _boundary(vertices: Vertices, faces: Faces) -> NDArray[np.int64]:
    """Edges (n, 2) with one face, in the direction of the face that is missing there."""
    _, inverse, counts = np.unique(edge_keys(vertices, faces), return_inverse=True, return_counts=True)
    boundary = counts[inverse.ravel()] == 1
    boundary &= ~np.repeat(boundary.reshape(-1, 3).all(1), 3)  # a single face: the only face over its boundary is that face again
    return np.stack([faces[:, [1, 2, 0]].ravel()[boundary], faces.ravel()[boundary]], 1).astype(np.int64)


def boundary_loops(edges: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Vertices of each closed loop of directed `edges` (n, 2), of which at most one leaves each vertex."""
    following = dict(edges.tolist())
    loops = []
    for first in sorted(following):
        if first not in following:
            continue
        loop, vertex = [first], following.pop(first)
        while vertex != first and vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == first:
            loops.append(np.array(loop, np.int64))
    return loops


def fill_hole(vertices: Vertices, loop: NDArray[np.int64], edges: NDArray[np.int64]) -> Faces:
    """Faces (n − 2, 3) of least area over a loop of n vertices whose diagonals are not in `edges` (sorted keys); none if there are none."""
    n = len(loop)
    points = vertices[loop]
    low, high = np.minimum(loop[:, None], loop), np.maximum(loop[:, None], loop)
    key = low * len(vertices) + high
    used = edges[np.minimum(np.searchsorted(edges, key), len(edges) - 1)] == key
    used[np.arange(n), (np.arange(n) + 1) % n] = used[(np.arange(n) + 1) % n, np.arange(n)] = False
    cost, split = np.where(used, np.inf, 0.0), np.zeros((n, n), np.int64)
    for span in range(2, n):
        i = np.arange(n - span)
        k = i + span
        middle = i[:, None] + np.arange(1, span)
        areas = np.linalg.norm(np.cross(points[middle] - points[i, None], points[k, None] - points[i, None]), axis=2)
        total = cost[i[:, None], middle] + cost[middle, k[:, None]] + areas
        best = total.argmin(1)
        split[i, k] = middle[i, best]
        cost[i, k] += total[i, best]  # inf where the diagonal is in use
    if n < 3 or not np.isfinite(cost[0, n - 1]):
        return np.zeros((0, 3), np.int32)
    faces, open_spans = [], [(0, n - 1)]
    while open_spans:
        first, last = open_spans.pop()
        if last - first > 1:
            apex = int(split[first, last])
            faces.append((loop[first], loop[apex], loop[last]))
            open_spans += [(first, apex), (apex, last)]
    return np.array(faces, np.int32).reshape(-1, 3)
