"""MikkTSpace tangents for glTF, used by the normal-map bake and the export.

A triangle's tangent follows from its positions and UVs. At a vertex the tangents of triangles that share its position, normal and UV and
are connected over edges without change of handedness are averaged, each projected onto the vertex's tangent plane and weighted by its
corner angle. A vertex with several such groups (mirrored UVs) is split. glTF stores v downwards while tangent space has +Y up, so
handedness is computed with v flipped: the bitangent w · (normal × tangent) points up in the image.

Mikkelsen, *Simulation of wrinkled surfaces revisited*, 2008 (MikkTSpace); glTF 2.0 specification, section 3.7.2.1 (Meshes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gsbake.geometry.vectors import unit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Tangents:
    """Result of `tangents`.

    `tangent` (v', 4) float32, xyz of unit length and orthogonal to the normal, w = ±1; `source` (v',) input vertex of each vertex; `faces`
    (f, 3) int32. The first v vertices are the input's; copies of split vertices follow.
    """

    tangent: NDArray[np.float32]
    source: NDArray[np.int32]
    faces: NDArray[np.int32]


def tangents(position: NDArray[Any], normal: NDArray[Any], uv: NDArray[Any], faces: NDArray[Any]) -> Tangents:
    """Tangent per vertex from `position` (v, 3), unit `normal` (v, 3), `uv` (v, 2) with the origin at the top left, and `faces` (f, 3)."""
    p, n, t = (np.asarray(x, np.float64) for x in (position, normal, uv))
    triangles = np.asarray(faces, np.int64).reshape(-1, 3)
    tangent, positive, valid = _face_tangents(p, np.stack([t[:, 0], 1 - t[:, 1]], 1), triangles)
    group = _groups(np.concatenate([p, n, t], 1), triangles, positive, valid)

    count = int(group.max(initial=-1)) + 1
    total, mirrored = np.zeros((count, 3)), np.zeros(count, bool)
    for k in range(3):
        here, ahead, behind = (triangles[:, (k + i) % 3] for i in range(3))
        angle = np.einsum("nd,nd->n", _project_to_plane(p[ahead] - p[here], n[here]), _project_to_plane(p[behind] - p[here], n[here]))
        term = np.arccos(np.clip(angle, -1, 1))[:, None] * _project_to_plane(tangent, n[here]) * valid[:, None]
        for axis in range(3):
            total[:, axis] += np.bincount(group[:, k], term[:, axis], count)
        mirrored[group[valid & ~positive, k]] = True

    source, corner, group_of = _split(triangles, group, len(p))
    out = np.zeros((len(source), 4))
    out[:, 3] = 1
    used = group_of >= 0
    out[used, :3] = unit(total)[group_of[used]]
    out[used & mirrored[group_of], 3] = -1
    undefined = np.flatnonzero(np.einsum("nd,nd->n", out[:, :3], out[:, :3]) < 0.5)
    out[undefined, :3] = _any_perpendicular(n[source[undefined]])
    return Tangents(out.astype(np.float32), source.astype(np.int32), corner.astype(np.int32))


def _project_to_plane(vector: Floats, normal: Floats) -> Floats:
    """Unit directions (n, 3) of `vector` (n, 3) projected onto the planes of `normal` (n, 3)."""
    return unit(vector - normal * np.einsum("nd,nd->n", normal, vector)[:, None])


def _groups(keys: Floats, faces: Ints, positive: NDArray[np.bool_], valid: NDArray[np.bool_]) -> Ints:
    """Group (f, 3) of each triangle corner: corners at one point connected over edges between triangles of equal handedness.

    Vertices with equal rows of `keys` (v, k) are one point. A triangle without UV area joins any group at its corners.
    """
    # Adding 0 turns -0 into +0: both are the same point.
    point = np.unique(keys.astype(np.float32) + np.float32(0), axis=0, return_inverse=True)[1].ravel()
    corner = point[faces]
    corners = np.arange(faces.size).reshape(-1, 3)
    count = len(keys)
    ahead = corner[:, [0, 1, 2]] * count + corner[:, [1, 2, 0]]
    back = (corner[:, [1, 2, 0]] * count + corner[:, [0, 1, 2]]).ravel()
    order = np.argsort(ahead.ravel(), kind="stable")
    place = np.minimum(np.searchsorted(ahead.ravel()[order], back), max(faces.size - 1, 0))
    other = order[place]
    mine = np.arange(faces.size)
    linked = (ahead.ravel()[other] == back) & valid[mine // 3] & valid[other // 3] & (positive[mine // 3] == positive[other // 3])
    mine, other = mine[linked], other[linked]

    def following(edge: Ints) -> Ints:
        return edge - edge % 3 + (edge + 1) % 3

    start, end = np.concatenate([mine, following(mine)]), np.concatenate([following(other), other])
    links = coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(faces.size, faces.size))
    group = connected_components(links, directed=False)[1].astype(np.int64)[corners] if faces.size else corners
    flat = ~valid
    if flat.any() and valid.any():
        some = np.full(count, -1, np.int64)
        some[corner[valid].ravel()] = group[valid].ravel()
        group[flat] = np.where(some[corner[flat]] >= 0, some[corner[flat]], group[flat])
    return group


def _split(faces: Ints, group: Ints, vertices: int) -> tuple[Ints, Ints, Ints]:
    """Split vertices with several groups: source vertex (v',), faces (f, 3), group (v',; -1 where unused).

    The first group of each vertex keeps its index; others are appended.
    """
    width = int(group.max(initial=0)) + 1
    pairs, inverse = np.unique(faces.ravel() * width + group.ravel(), return_inverse=True)
    owner, owned = pairs // width, pairs % width
    first = np.ones(len(pairs), bool)
    first[1:] = owner[1:] != owner[:-1]
    index = np.where(first, owner, vertices - 1 + np.cumsum(~first))
    source = np.concatenate([np.arange(vertices), owner[~first]])
    group_of = np.full(len(source), -1, np.int64)
    group_of[index] = owned
    return source, index[inverse.ravel()].reshape(-1, 3), group_of


def _face_tangents(p: Floats, up: Floats, faces: Ints) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Per triangle: unit direction (f, 3) of increasing u, whether its UV winding is positive, whether it is non-degenerate."""
    a, b, c = (faces[:, k] for k in range(3))
    d1, d2 = p[b] - p[a], p[c] - p[a]
    s1, s2 = up[b] - up[a], up[c] - up[a]
    area = s1[:, 0] * s2[:, 1] - s1[:, 1] * s2[:, 0]
    positive = area > 0
    along = (s2[:, 1:] * d1 - s1[:, 1:] * d2) * np.where(positive, 1.0, -1.0)[:, None]
    tangent = unit(along)
    valid = (np.abs(area) > 1e-20) & (np.einsum("nd,nd->n", tangent, tangent) > 0.5)
    return tangent, positive, valid


def _any_perpendicular(normal: Floats) -> Floats:
    """A unit vector (n, 3) perpendicular to each normal, for vertices with degenerate UVs."""
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    return unit(np.cross(normal, axis))


def frame_to_world(vector: NDArray[Any], normal: NDArray[Any], tangent: NDArray[Any]) -> Floats:
    """Unit directions (n, 3) of tangent-space `vector` (n, 3), for interpolated `normal` (n, 3) and `tangent` (n, 4).

    As MikkTSpace requires, the interpolated vectors are not normalised first.
    """
    n, t = np.asarray(normal, np.float64), np.asarray(tangent, np.float64)
    v = np.asarray(vector, np.float64)
    bitangent = np.cross(n, t[:, :3]) * t[:, 3:4]
    return unit(v[:, :1] * t[:, :3] + v[:, 1:2] * bitangent + v[:, 2:] * n)


def world_to_frame(vector: NDArray[Any], normal: NDArray[Any], tangent: NDArray[Any]) -> Floats:
    """Unit tangent-space directions (n, 3) of `vector` (n, 3): the exact inverse of `frame_to_world`."""
    n, t = np.asarray(normal, np.float64), np.asarray(tangent, np.float64)
    t3, v = t[:, :3], np.asarray(vector, np.float64)
    b = np.cross(n, t3) * t[:, 3:4]
    # Cramer's rule for v = x t + y b + z n; the common determinant only scales, and its sign is that of w.
    columns = [np.einsum("nd,nd->n", v, across) for across in (np.cross(b, n), np.cross(n, t3), np.cross(t3, b))]
    return unit(np.stack(columns, 1) * t[:, 3:4])
