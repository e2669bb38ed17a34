"""Mesh clean-up and decimation: the narrow door to PyMeshLab, which no other module imports.

What needs no library (loose pieces, smoothing, measures) is done here with NumPy and SciPy; quadric edge collapse (Garland &
Heckbert, *Surface simplification using quadric error metrics*, SIGGRAPH 1997), hole filling and manifold repair are MeshLab's.
All functions take and return `vertices` (v, 3) float64 and `faces` (f, 3) int32 with outward winding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pymeshlab
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

Vertices = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True)
class Topology:
    """What a mesh is: loose `components`, `watertight` (each edge has exactly two faces), counts of border and non-manifold edges."""

    components: int
    watertight: bool
    border_edges: int
    non_manifold_edges: int


def drop_unused(vertices: Vertices, faces: NDArray[Any]) -> tuple[Vertices, Faces]:
    """Without vertices that no face uses, order kept."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int32)


def topology(vertices: Vertices, faces: Faces) -> Topology:
    """Count pieces and edges; vertices are taken as they are (no merging by position)."""
    if len(faces) == 0:
        return Topology(0, False, 0, 0)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    _, counts = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_counts=True)
    border, crowded = int((counts == 1).sum()), int((counts > 2).sum())
    pieces = len(np.unique(piece_of_faces(vertices, faces)))
    return Topology(pieces, border == 0 and crowded == 0, border, crowded)


def piece_of_faces(vertices: Vertices, faces: Faces) -> NDArray[Any]:
    """The loose piece (f,) each face belongs to; the numbers count vertices without faces, too."""
    return _labels(len(vertices), faces)[faces[:, 0]]


def drop_small(vertices: Vertices, faces: Faces, min_share: float) -> tuple[Vertices, Faces, int]:
    """Without loose pieces below `min_share` of the largest piece's area and without sealed hollows inside; also how many went.

    A closed piece of negative volume is the wall of a hollow that nobody can see.
    """
    if len(faces) == 0:
        return vertices, faces, 0
    piece = piece_of_faces(vertices, faces)
    corners = vertices[faces]
    area = np.bincount(piece, np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))
    volume = np.bincount(piece, np.einsum("fd,fd->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    _, inverse, counts = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True, return_counts=True)
    open_pieces = np.zeros(len(area), np.bool_)
    open_pieces[np.repeat(piece, 3)[counts[inverse.ravel()] == 1]] = True
    keep = (area >= min_share * area.max()) & (open_pieces | (volume > 0) | (area == area.max()))
    gone = int((area > 0).sum() - (keep & (area > 0)).sum())
    if gone == 0:
        return vertices, faces, 0
    return (*drop_unused(vertices, faces[keep[piece]]), gone)


def smooth(vertices: Vertices, faces: Faces, steps: int, shrink: float = 0.5, swell: float = -0.53) -> Vertices:
    """Taubin smoothing, `steps` pairs of a shrinking and a swelling step; border vertices stay.

    Taubin, *A signal processing approach to fair surface design*, SIGGRAPH 1995: uniform weights, pass band 1/λ + 1/μ.
    """
    if steps == 0 or len(faces) == 0:
        return vertices
    n = len(vertices)
    start = faces[:, [0, 1, 2, 1, 2, 0]].T.ravel()
    end = faces[:, [1, 2, 0, 0, 1, 2]].T.ravel()
    adjacency = sparse.csr_matrix((np.ones(len(start)), (start, end)), shape=(n, n))
    # An edge inside is entered twice, a border edge once.
    border = np.zeros(n, np.bool_)
    single = adjacency.tocoo()
    border[single.row[single.data == 1]] = True
    adjacency.data[:] = 1
    degree = np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)[:, None]
    free = ~border[:, None]
    out = vertices.copy()
    for _ in range(steps):
        for factor in (shrink, swell):
            out += factor * free * (adjacency @ out / degree - out)
    return out


def repair(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Without duplicate, degenerate and folded faces and without edges or vertices that join more than one sheet."""
    meshes = _load(vertices, faces)
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
    meshes.meshing_repair_non_manifold_vertices(vertdispratio=0)
    return _store(meshes)


def close_holes(vertices: Vertices, faces: Faces, max_edges: int) -> tuple[Vertices, Faces]:
    """With every hole of at most `max_edges` border edges filled by triangles between its border's vertices."""
    if topology(vertices, faces).border_edges == 0:
        return vertices, faces
    meshes = _load(vertices, faces)
    meshes.meshing_close_holes(maxholesize=max_edges, selfintersection=False)
    return _store(meshes)


def decimate(
    vertices: Vertices, faces: Faces, target: int, max_error: float | None = None
) -> tuple[Vertices, Faces, float]:
    """Quadric edge collapse to about `target` faces; borders, normals and topology are kept. Also returns the error.

    The error is the largest distance from a vertex of the input to the result. When it exceeds `max_error` (same units) the collapse
    is repeated with twice the faces, until it fits or nothing would be collapsed.
    """
    while True:
        if len(faces) <= target:
            return vertices, faces, 0.0
        meshes = _load(vertices, faces)
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=int(target),
            qualitythr=0.3,
            preserveboundary=True,
            boundaryweight=2.0,
            preservenormal=True,
            preservetopology=True,
            optimalplacement=True,
            planarquadric=True,  # well-shaped triangles where the surface is flat
            autoclean=True,
        )
        fewer = _store(meshes)
        error = deviation(vertices, *fewer)
        if max_error is None or error <= max_error:
            return (*fewer, error)
        target *= 2


def deviation(points: Vertices, vertices: Vertices, faces: Faces) -> float:
    """The largest distance from `points` (n, 3) to a mesh: the one-sided Hausdorff distance."""
    if len(points) == 0 or len(faces) == 0:
        return float("inf") if len(points) else 0.0
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(points, np.float64)))
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
    figures = meshes.get_hausdorff_distance(sampledmesh=0, targetmesh=1, samplevert=True, samplenum=len(points))
    return float(figures["max"])


def _labels(count: int, faces: Faces) -> NDArray[Any]:
    """The loose piece (count,) each vertex belongs to."""
    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = sparse.coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def _load(vertices: Vertices, faces: Faces) -> Any:
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)))
    return meshes


def _store(meshes: Any) -> tuple[Vertices, Faces]:
    mesh = meshes.current_mesh()
    return drop_unused(np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int32).reshape(-1, 3))
