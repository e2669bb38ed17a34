"""Decimation of an unwrapped mesh under an error bound: charts, seams and texture coordinates are kept.

The bound is on the deviation of the two surfaces, as in `gsbake.meshing.decimation`; the quadrics' cost, which orders the collapses, only
estimates it. So collapses end at a cost, the deviation is measured, and the cost is corrected until the bound is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.tangents import tangents
from gsbake.gltf.write import GltfMesh
from gsbake.meshing.decimation import Deviation, surface_deviation
from gsbake.targets.collapse_kernel import CREASE, FIXED, INSIDE, collapse
from gsbake.targets.quadrics import crease_quadrics, points, triangle_quadrics
from gsbake.texturing.normal_map import vertex_normals
from gsbake.texturing.texels import overlapping

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Length of texture that slides by one length on the surface: half as bad as a surface that is off by it.
TEXTURE_WEIGHT = 0.5
#: Farthest that a seam moves in the texture: a quarter of the padding between charts, so that charts never meet. Where seams would keep a
#: mesh above its number of triangles, more is tried, as long as charts do not overlap.
SEAM_TOLERANCE = 0.25 / 128
MAX_SEAM_TOLERANCE = 2 / 128
#: Root of the largest cost of a collapse, as a share of the diagonal: beyond it a mesh keeps its triangles rather than its number.
MAX_ERROR = 0.02
#: Factor of decimation from which seams take up so many of the triangles that more tolerance is tried.
FEW = 8
#: Resolution at which overlaps are looked for, in texels.
OVERLAP_SIZE = 2048
#: Corrections of the cost, and share of the bound that ends them.
MAX_TRIES, CLOSE_ENOUGH = 6, 0.7


@dataclass(frozen=True)
class WedgeMesh:
    """An unwrapped mesh by vertices and wedges: `position` (v, 3), `uv` (w, 2), `vertex` (w,) of each wedge, `faces` (f, 3) of wedges,
    `kind` (v,): inside a chart, on a crease, or fixed; `creases` (e, 2) the sides of seams and borders as wedges."""

    position: Doubles
    uv: Doubles
    vertex: Ints
    faces: Ints
    kind: Ints
    creases: Ints

    @staticmethod
    def of(mesh: GltfMesh) -> WedgeMesh:
        """The wedges of a mesh: its vertices, those of equal position and texture coordinates merged."""
        keys = np.concatenate([mesh.position, mesh.uv], 1) + np.float32(0)  # −0 is +0
        _, first, wedge_of = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        wedge_of = wedge_of.ravel()
        position, vertex = np.unique(mesh.position[first] + np.float32(0), axis=0, return_inverse=True)
        vertex = vertex.ravel()
        faces = wedge_of[mesh.faces.astype(np.int64)]
        corner = vertex[faces]
        proper = (corner[:, 0] != corner[:, 1]) & (corner[:, 1] != corner[:, 2]) & (corner[:, 2] != corner[:, 0])
        faces = faces[proper]
        kind, creases = _kinds(faces, vertex, len(position))
        return WedgeMesh(position.astype(np.float64), mesh.uv[first].astype(np.float64), vertex, faces, kind, creases)

    @property
    def surface(self) -> tuple[Doubles, NDArray[np.int32]]:
        """Vertices (v, 3) and triangles (f, 3) without seams."""
        return self.position, self.vertex[self.faces].astype(np.int32)

    def to_mesh(self) -> GltfMesh:
        """The mesh with smooth normals and MikkTSpace tangents."""
        position, corners = self.surface
        used, faces = np.unique(self.faces, return_inverse=True)
        faces = faces.reshape(-1, 3)
        owner = self.vertex[used]
        normal = vertex_normals(position, corners)[owner].astype(np.float32)
        place, uv = position[owner].astype(np.float32), self.uv[used].astype(np.float32)
        frames = tangents(place, normal, uv, faces)
        source = frames.source
        return GltfMesh(place[source], normal[source], frames.tangent, uv[source], frames.faces)


def decimate_to_count(mesh: WedgeMesh, target: int) -> WedgeMesh:
    """The mesh with at most `target` triangles, or as few as seams and the largest error allow."""
    limit = (MAX_ERROR * float(np.linalg.norm(np.ptp(mesh.position, axis=0)))) ** 2
    best, tolerance = decimate_to_cost(mesh, limit, target), SEAM_TOLERANCE
    if len(best.faces) <= target and len(mesh.faces) < FEW * target:
        return best
    overlap, deviation = overlapping(mesh.uv, mesh.faces, OVERLAP_SIZE), surface_deviation(mesh.surface, best.surface).quantile
    while tolerance < MAX_SEAM_TOLERANCE:
        tolerance *= 2
        tried = decimate_to_cost(mesh, limit, target, tolerance)
        if overlapping(tried.uv, tried.faces, OVERLAP_SIZE) > overlap:
            break
        error = surface_deviation(mesh.surface, tried.surface).quantile
        if (max(len(tried.faces), target), error) < (max(len(best.faces), target), deviation):
            best, deviation = tried, error
    return best


def decimate_to_cost(mesh: WedgeMesh, max_cost: float, target: int = 0, tolerance: float = SEAM_TOLERANCE) -> WedgeMesh:
    """The mesh after all collapses of at most `max_cost` (squared units), or with `target` triangles; seams move by `tolerance` (UV)."""
    scale = TEXTURE_WEIGHT * _length_per_uv(mesh)
    point = points(mesh.position, mesh.uv, mesh.vertex, scale)
    quadric = triangle_quadrics(point, mesh.faces)
    if len(mesh.creases):
        quadric += crease_quadrics(point, mesh.creases[:, :2], _face_normals(mesh)[mesh.creases[:, 2]])
    faces, alive = mesh.faces.copy(), np.ones(len(mesh.faces), bool)
    collapse(point, mesh.vertex, faces, mesh.kind, quadric, alive, int(target), float(max_cost), tolerance * scale)
    faces = faces[alive]
    position = mesh.position.copy()
    position[mesh.vertex[faces.ravel()]] = point[faces.ravel(), :3]
    kind, creases = _kinds(faces, mesh.vertex, len(position))
    return WedgeMesh(position, point[:, 3:] / scale, mesh.vertex, faces, kind, creases)


def decimate_to_bound(mesh: WedgeMesh, bound: float) -> tuple[WedgeMesh, Deviation]:
    """The mesh with the fewest triangles found whose deviation is at most `bound` (units of the mesh); itself where there is none."""
    best: tuple[WedgeMesh, Deviation] = mesh, Deviation(0.0, 0.0)
    cost = (bound / 3) ** 2  # the quadrics' mean is well below the 99.9 % quantile
    for _ in range(MAX_TRIES if bound > 0 else 0):
        tried = decimate_to_cost(mesh, cost)
        deviation = surface_deviation(mesh.surface, tried.surface)
        if deviation.quantile <= bound:
            if len(tried.faces) < len(best[0].faces):
                best = tried, deviation
            if deviation.quantile >= CLOSE_ENOUGH * bound:
                break
        cost *= np.clip(0.85 * bound / max(deviation.quantile, 1e-30), 0.2, 3.0) ** 2
    return best


def _kinds(faces: Ints, vertex: Ints, count: int) -> tuple[Ints, Ints]:
    """Kind (count,) of the vertices, and the sides of creases (e, 3): two wedges, and the triangle that has them."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(vertex[start], vertex[end]), np.maximum(vertex[start], vertex[end])
    forward = vertex[start] == low
    one, two = np.where(forward, start, end), np.where(forward, end, start)
    edge, inverse, sides = np.unique(low * count + high, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    first = np.full(len(edge), -1)
    first[inverse[::-1]] = np.arange(len(start))[::-1]
    differs = np.zeros(len(edge), bool)
    np.logical_or.at(differs, inverse, (one != one[first[inverse]]) | (two != two[first[inverse]]))
    crease = (sides == 1) | ((sides == 2) & differs)
    ends = np.concatenate([edge[crease] // count, edge[crease] % count])
    degree = np.bincount(ends, minlength=count)
    kind = np.where(degree == 0, INSIDE, np.where(degree == 2, CREASE, FIXED))
    wedges = np.bincount(vertex[np.unique(faces)], minlength=count)
    kind[(kind == INSIDE) & (wedges > 1)] = FIXED
    kind[(kind == CREASE) & (wedges > 2)] = FIXED
    kind[np.concatenate([edge[sides > 2] // count, edge[sides > 2] % count]).astype(np.int64)] = FIXED
    mine = crease[inverse]
    triangle = np.repeat(np.arange(len(faces)), 3)
    return kind.astype(np.int64), np.stack([start[mine], end[mine], triangle[mine]], 1)


def _face_normals(mesh: WedgeMesh) -> Doubles:
    corner = mesh.position[mesh.vertex[mesh.faces]]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return np.asarray(cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30))


def _length_per_uv(mesh: WedgeMesh) -> float:
    """Length on the surface of one unit of texture, from the areas."""
    corner, uv = mesh.position[mesh.vertex[mesh.faces]], mesh.uv[mesh.faces]
    area: Any = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    texture = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    return float(np.sqrt(area / max(texture, 1e-30)))
