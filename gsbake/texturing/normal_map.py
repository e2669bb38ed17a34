"""Tangent-space normal map of the dense mesh on the low-poly mesh, and smooth vertex normals.

From each texel's point on the low-poly mesh rays are cast both ways along its normal; the nearer hit on the dense mesh within a bound, if
it faces the same way, gives its smooth normal, coded in the texel's MikkTSpace frame (OpenGL: +Y up in the image). The bound follows from
the distances found, that is from the decimation error. A texel without such a hit stays flat.

Vertex normals are weighted by corner angle: Thürmer & Wüthrich, *Computing vertex normals from polygonal facets*, JGT 1998.
Cohen, Olano & Manocha, *Appearance-preserving simplification*, SIGGRAPH 1998 (normal maps of simplified surfaces).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import Hits, RayCaster
from gsbake.geometry.tangents import world_to_frame
from gsbake.geometry.vectors import unit

Floats = NDArray[np.float64]

#: Largest search distance along the normal, as a share of the low-poly mesh's bounding-box diagonal.
MAX_DISTANCE = 0.05
#: The bound on accepted distances is this many times the 95th percentile of the distances found.
BOUND_FACTOR = 2.0
#: Least cosine between the normals of both meshes: below it, the hit is another sheet.
MIN_COSINE = 0.2


@dataclass(frozen=True)
class DenseSamples:
    """The dense mesh at each of n texels.

    `found` (n,) where there is one; `position` (n, 3) and unit `normal` (n, 3) in the mesh's frame, those of the low-poly mesh elsewhere;
    `bound`, the largest accepted distance.
    """

    found: NDArray[np.bool_]
    position: Floats
    normal: Floats
    bound: float


def vertex_normals(vertices: NDArray[Any], faces: NDArray[Any]) -> Floats:
    """Unit normals (v, 3) of `vertices` (v, 3) under `faces` (f, 3): face normals weighted by the corner angle; +z for an unused vertex."""
    p, triangles = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    corner = p[triangles]
    out = np.zeros_like(p)
    face = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    for k in range(3):
        e1, e2 = unit(corner[:, (k + 1) % 3] - corner[:, k]), unit(corner[:, (k + 2) % 3] - corner[:, k])
        angle = np.arccos(np.clip(np.einsum("nd,nd->n", e1, e2), -1, 1))
        for axis in range(3):
            out[:, axis] += np.bincount(triangles[:, k], angle * face[:, axis], len(p))
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.where(length > 1e-12, out / np.maximum(length, 1e-12), np.array([0.0, 0.0, 1.0]))


def sample_dense_mesh(
    position: NDArray[Any], normal: NDArray[Any], dense: RayCaster, dense_normals: NDArray[Any], diagonal: float
) -> DenseSamples:
    """The dense mesh along the normals of n texels with `position` (n, 3) and `normal` (n, 3) of the low-poly mesh.

    `dense_normals` (v, 3) are those of the dense mesh's vertices; `diagonal` is that of the low-poly mesh's bounding box.
    """
    hits, bound = hits_along_normals(position, normal, dense, dense_normals, diagonal)
    found = hits.hit
    found_position, found_normal = np.array(position, np.float64), unit(np.asarray(normal, np.float64))
    found_position[found] = dense.points(hits)[found]
    found_normal[found] = _smooth_normal(hits, dense, dense_normals)[found]
    return DenseSamples(found, found_position, found_normal, bound)


def hits_along_normals(
    position: NDArray[Any], normal: NDArray[Any], surface: RayCaster, surface_normals: NDArray[Any], diagonal: float
) -> tuple[Hits, float]:
    """The nearer of the two hits along and against the normals of n points, if it faces the same way and is within the bound; that bound.

    Arguments as of `sample_dense_mesh`; distances of the hits are absolute.
    """
    p, n = np.asarray(position, np.float64), unit(np.asarray(normal, np.float64))
    max_distance = MAX_DISTANCE * diagonal
    lift = 1e-3 * max_distance  # a surface exactly at the texel is hit by at least one of the two rays
    distance = np.full(len(p), np.inf)
    face, bary = np.full(len(p), -1, np.int32), np.zeros((len(p), 3), np.float32)
    for side in (1.0, -1.0):
        hits = surface.first_hit(p - side * lift * n, side * n)
        offset = np.abs(hits.distance - lift)
        facing = np.einsum("nd,nd->n", _smooth_normal(hits, surface, surface_normals), n) > MIN_COSINE
        take = hits.hit & (offset < distance) & (offset < max_distance) & facing
        distance[take], face[take], bary[take] = offset[take], hits.face[take], hits.bary[take]
    near = distance[np.isfinite(distance)]
    bound = float(min(max_distance, BOUND_FACTOR * np.quantile(near, 0.95) + 2 * lift)) if len(near) else 0.0
    far = ~(distance <= bound)
    face[far], bary[far], distance[far] = -1, 0, np.inf
    return Hits(face, bary, distance.astype(np.float32)), bound


def normal_map(detail: DenseSamples, normal: NDArray[Any], tangent: NDArray[Any]) -> NDArray[np.float32]:
    """Tangent-space normals (n, 3) coded 0..1 (0.5 is zero, +Y up); flat where the dense mesh was not found.

    `normal` (n, 3) and `tangent` (n, 4) are those of the low-poly mesh, interpolated at the texels and not normalised.
    """
    local = world_to_frame(detail.normal, normal, tangent)
    usable = detail.found & np.isfinite(local).all(1) & (local[:, 2] > 0.05)
    local[~usable] = (0.0, 0.0, 1.0)
    return (0.5 * local + 0.5).astype(np.float32)


def _smooth_normal(hits: Hits, dense: RayCaster, normals: NDArray[Any]) -> Floats:
    """Interpolated unit normals (n, 3) at hits; 0 on a miss."""
    corners = np.asarray(normals, np.float64)[dense.faces[np.maximum(hits.face, 0)]]
    return unit(np.einsum("nk,nkd->nd", hits.bary.astype(np.float64), corners))
