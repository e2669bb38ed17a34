"""Mesh clean-up: connected components, smoothing and topology, with NumPy and SciPy.

All functions take and return `vertices` (v, 3) float64 and `faces` (f, 3) int32 with outward winding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

Vertices = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True)
class Topology:
    """Number of connected `components`, `watertight` (each edge has exactly two faces), numbers of boundary and non-manifold edges."""

    components: int
    watertight: bool
    border_edges: int
    non_manifold_edges: int


def remove_unused_vertices(vertices: Vertices, faces: NDArray[Any]) -> tuple[Vertices, Faces]:
    """Remove vertices that no face uses; the order is kept."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int32)


def topology(vertices: Vertices, faces: Faces) -> Topology:
    """Topology of a mesh; vertices at equal positions are not merged."""
    if len(faces) == 0:
        return Topology(0, False, 0, 0)
    _, counts = np.unique(edge_keys(vertices, faces), return_counts=True)
    border, non_manifold = int((counts == 1).sum()), int((counts > 2).sum())
    components = len(np.unique(face_components(vertices, faces)))
    return Topology(components, border == 0 and non_manifold == 0, border, non_manifold)


def face_components(vertices: Vertices, faces: Faces) -> NDArray[Any]:
    """Index (f,) of each face's connected component; unused vertices are components of their own."""
    return _vertex_components(len(vertices), faces)[faces[:, 0]]


def component_areas(vertices: Vertices, faces: Faces, component: NDArray[Any]) -> NDArray[np.float64]:
    """Twice the area of each component; `component` (f,) as from `face_components`."""
    corners = vertices[faces]
    return np.asarray(
        np.bincount(component, np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)), np.float64
    )


def remove_small_components(vertices: Vertices, faces: Faces, min_share: float) -> tuple[Vertices, Faces, int]:
    """Remove components below `min_share` of the largest component's area, and enclosed cavities; also returns the number removed.

    A closed component of negative volume is the wall of an enclosed cavity.
    """
    if len(faces) == 0:
        return vertices, faces, 0
    component = face_components(vertices, faces)
    corners = vertices[faces]
    area = component_areas(vertices, faces, component)
    volume = np.bincount(component, np.einsum("fd,fd->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    _, inverse, counts = np.unique(edge_keys(vertices, faces), return_inverse=True, return_counts=True)
    open_components = np.zeros(len(area), np.bool_)
    open_components[np.repeat(component, 3)[counts[inverse.ravel()] == 1]] = True
    keep = (area >= min_share * area.max()) & (open_components | (volume > 0) | (area == area.max()))
    removed = int((area > 0).sum() - (keep & (area > 0)).sum())
    if removed == 0:
        return vertices, faces, 0
    return (*remove_unused_vertices(vertices, faces[keep[component]]), removed)


def smooth(vertices: Vertices, faces: Faces, steps: int, shrink: float = 0.5, inflate: float = -0.53) -> Vertices:
    """Taubin smoothing: `steps` pairs of a shrinking and an inflating step; boundary vertices are fixed.

    Taubin, *A signal processing approach to fair surface design*, SIGGRAPH 1995: uniform weights, pass band 1/λ + 1/μ.
    """
    if steps == 0 or len(faces) == 0:
        return vertices
    n = len(vertices)
    start = faces[:, [0, 1, 2, 1, 2, 0]].T.ravel()
    end = faces[:, [1, 2, 0, 0, 1, 2]].T.ravel()
    adjacency = sparse.csr_matrix((np.ones(len(start)), (start, end)), shape=(n, n))
    # An interior edge has two entries, a boundary edge one.
    border = np.zeros(n, np.bool_)
    entries = adjacency.tocoo()
    border[entries.row[entries.data == 1]] = True
    adjacency.data[:] = 1
    degree = np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)[:, None]
    interior = ~border[:, None]
    out = vertices.copy()
    for _ in range(steps):
        for factor in (shrink, inflate):
            out += factor * interior * (adjacency @ out / degree - out)
    return out


def edge_keys(vertices: Vertices, faces: Faces) -> NDArray[np.int64]:
    """One integer (3 f,) per face and edge, equal for edges with equal vertices."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    return np.asarray(edges[:, 0] * len(vertices) + edges[:, 1])


def _vertex_components(count: int, faces: Faces) -> NDArray[Any]:
    """Index (count,) of each vertex's connected component."""
    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    adjacency = sparse.coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    return np.asarray(connected_components(adjacency, directed=False)[1])
