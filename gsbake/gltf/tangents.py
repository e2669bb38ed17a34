"""Tangents after MikkTSpace, for glTF: the one function that both the normal-map bake and the export use.

Every triangle's tangent follows from its positions and UVs; at a vertex the triangles that share its position, normal, UV and handedness
are averaged, each projected on the vertex's tangent plane and weighted by its corner angle there. A vertex used by mirrored and unmirrored
triangles is split. glTF stores v downwards while tangent space has +Y up, so handedness is taken with v flipped: the bitangent
w · (normal × tangent) points up in the image.

Mikkelsen, *Simulation of wrinkled surfaces revisited*, 2008 (MikkTSpace); glTF 2.0 specification, section 3.7.2.1 (Meshes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Tangents:
    """`tangent` (v', 4) float32, xyz of unit length and orthogonal to the normal, w = ±1; `source` (v',) input vertex of each vertex;

    `faces` (f, 3) int32. Without mirrored UVs `source` is 0..v-1 and the faces are the input's.
    """

    tangent: NDArray[np.float32]
    source: NDArray[np.int32]
    faces: NDArray[np.int32]


def _unit(x: Floats) -> Floats:
    """Rows of (n, 3) at unit length; rows too short to have a direction become 0."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return np.where(length > 1e-20, x / np.maximum(length, 1e-20), 0.0)


def tangents(position: NDArray[Any], normal: NDArray[Any], uv: NDArray[Any], faces: NDArray[Any]) -> Tangents:
    """Tangent per vertex from `position` (v, 3), unit `normal` (v, 3), `uv` (v, 2) with the origin at the top left, and `faces` (f, 3)."""
    p, n, t = (np.asarray(x, np.float64) for x in (position, normal, uv))
    triangles = np.asarray(faces, np.int64)
    up = np.stack([t[:, 0], 1 - t[:, 1]], 1)
    tangent, positive, valid = _face_tangents(p, up, triangles)

    # Triangles without area in the UV plane have no handedness of their own: they go along with the vertex's others.
    shown = np.zeros((2, len(p)), bool)
    for side in (0, 1):
        shown[side, triangles[valid & (positive == bool(side))].ravel()] = True
    split = np.flatnonzero(shown[0] & shown[1])
    twin = np.full(len(p), -1, np.int64)
    twin[split] = len(p) + np.arange(len(split))
    source = np.concatenate([np.arange(len(p)), split])
    mirrored = (valid & ~positive)[:, None] & (twin[triangles] >= 0)
    corner = np.where(mirrored, twin[triangles], triangles)

    # Two vertices may be one point of the surface (same position, normal, UV): MikkTSpace joins them first.
    w = np.where(shown[1], 1.0, np.where(shown[0], -1.0, 1.0))[source]
    w[len(p) :] = -1.0
    key = np.ascontiguousarray(np.concatenate([p, n, t], 1)[source].astype(np.float32) + np.float32(0))
    joined = np.unique(np.column_stack([key, w.astype(np.float32)]), axis=0, return_inverse=True)[1].ravel()

    total = np.zeros((int(joined.max()) + 1, 3)) if len(joined) else np.zeros((0, 3))
    for k in range(3):
        here, ahead, behind = (corner[:, (k + i) % 3] for i in range(3))
        at = n[source[here]]

        def flat(x: Floats, at: Floats = at) -> Floats:
            return _unit(x - at * np.einsum("nd,nd->n", at, x)[:, None])

        along = flat(p[source[ahead]] - p[source[here]])
        back = flat(p[source[behind]] - p[source[here]])
        angle = np.arccos(np.clip(np.einsum("nd,nd->n", along, back), -1, 1))
        term = np.where(valid[:, None], angle[:, None] * flat(tangent), 0.0)
        for axis in range(3):
            total[:, axis] += np.bincount(joined[here], term[:, axis], len(total))
    out = _unit(total)[joined] if len(joined) else np.zeros((0, 3))
    lost = np.flatnonzero(np.einsum("nd,nd->n", out, out) < 0.5)
    out[lost] = _any_perpendicular(n[source[lost]])
    return Tangents(np.column_stack([out, w]).astype(np.float32), source.astype(np.int32), corner.astype(np.int32))


def _face_tangents(p: Floats, up: Floats, faces: Ints) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Unit direction (f, 3) of growing u per triangle, whether its UVs turn as its corners do, and whether it has both areas."""
    a, b, c = (faces[:, k] for k in range(3))
    d1, d2 = p[b] - p[a], p[c] - p[a]
    s1, s2 = up[b] - up[a], up[c] - up[a]
    area = s1[:, 0] * s2[:, 1] - s1[:, 1] * s2[:, 0]
    positive = area > 0
    along = (s2[:, 1:] * d1 - s1[:, 1:] * d2) * np.where(positive, 1.0, -1.0)[:, None]
    tangent = _unit(along)
    valid = (np.abs(area) > 1e-20) & (np.einsum("nd,nd->n", tangent, tangent) > 0.5)
    return tangent, positive, valid


def _any_perpendicular(normal: Floats) -> Floats:
    """Some unit vector (n, 3) perpendicular to each normal, for vertices whose UVs give no direction."""
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    return _unit(np.cross(normal, axis))


def frame_to_world(vector: NDArray[Any], normal: NDArray[Any], tangent: NDArray[Any]) -> Floats:
    """Unit directions (n, 3) of tangent-space `vector` (n, 3), for interpolated `normal` (n, 3) and `tangent` (n, 4).

    As MikkTSpace asks, the interpolated vectors are used as they come, without normalising them first.
    """
    n, t = np.asarray(normal, np.float64), np.asarray(tangent, np.float64)
    v = np.asarray(vector, np.float64)
    bitangent = np.cross(n, t[:, :3]) * t[:, 3:4]
    return _unit(v[:, :1] * t[:, :3] + v[:, 1:2] * bitangent + v[:, 2:] * n)


def world_to_frame(vector: NDArray[Any], normal: NDArray[Any], tangent: NDArray[Any]) -> Floats:
    """Unit tangent-space directions (n, 3) of `vector` (n, 3): the exact inverse of `frame_to_world`."""
    n, t = np.asarray(normal, np.float64), np.asarray(tangent, np.float64)
    t3, v = t[:, :3], np.asarray(vector, np.float64)
    b = np.cross(n, t3) * t[:, 3:4]
    # Cramer's rule for v = x t + y b + z n; the common determinant only scales, and its sign is that of w.
    columns = [np.einsum("nd,nd->n", v, across) for across in (np.cross(b, n), np.cross(n, t3), np.cross(t3, b))]
    return _unit(np.stack(columns, 1) * t[:, 3:4])
