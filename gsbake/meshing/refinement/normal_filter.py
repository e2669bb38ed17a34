"""Feature-preserving denoising of the dense mesh: bilateral filtering of its face normals, and vertices that follow them.

Fused depth and silhouettes leave a ripple of a fraction of a voxel. It hardly moves the surface, but tilts its normals by degrees, and
those of shiny materials decide what they reflect. Each face normal becomes the mean of its own and those across its edges, weighted by area
and by a Gaussian of their difference, a few times: within smooth regions the ripple averages out, and edges, whose normals differ by much
more than its angle, stay. The vertices then move to the planes of their faces with the new normals.

Zheng et al., *Bilateral normal filtering for mesh denoising*, TVCG 2011 (their local scheme, over the three faces across edges); vertex
update of Sun et al., *Fast and effective feature-preserving mesh denoising*, TVCG 2007.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gsbake.meshing.cleanup import Faces, Vertices, edge_keys

Doubles = NDArray[np.float64]

#: Standard deviation of the Gaussian in degrees: above the ripple of fused depth, below creases.
ANGLE = 8.0
#: Vertex updates after filtering.
VERTEX_UPDATES = 10


def denoise(vertices: Vertices, faces: Faces, iterations: int) -> Vertices:
    """The vertices (v, 3) of a mesh whose face normals are filtered `iterations` times; faces without area are left out of the means."""
    if not iterations or len(faces) == 0:
        return vertices
    return follow_normals(vertices, faces, filter_normals(vertices, faces, iterations))


def filter_normals(vertices: Vertices, faces: Faces, iterations: int) -> Doubles:
    """Unit normals (f, 3) of the faces, filtered; 0 of faces without area."""
    normal, area = face_normals(vertices, faces)
    neighbour = neighbours_across_edges(vertices, faces)
    weight = np.where(neighbour >= 0, area[neighbour], 0)
    scale = -0.5 / np.radians(ANGLE) ** 2
    for _ in range(iterations):
        around = normal[neighbour]
        similar = weight * np.exp(scale * np.square(around - normal[:, None]).sum(2))
        total = area[:, None] * normal + (similar[..., None] * around).sum(1)
        normal = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(float).tiny)
    return np.asarray(normal, np.float64)


def follow_normals(vertices: Vertices, faces: Faces, normal: Doubles) -> Vertices:
    """The vertices (v, 3) moved until the faces have about the unit normals `normal` (f, 3): each step takes a vertex to the mean of its
    projections on the planes through its faces' centroids."""
    count, moved = len(vertices), vertices.copy()
    rows, columns = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    incident = sparse.csr_matrix((np.ones(faces.size), (rows, columns)), shape=(count, len(faces)))
    degree = np.maximum(np.asarray(incident.sum(1)), 1)
    # Of each vertex, Σ n nᵀ and Σ n (n · c): the step is their difference at the vertex.
    products = (incident @ (normal[:, :, None] * normal[:, None]).reshape(-1, 9)).reshape(count, 3, 3)
    for _ in range(VERTEX_UPDATES):
        centroid = moved[faces].mean(1)
        heights = incident @ (normal * (normal * centroid).sum(1)[:, None])
        moved += (heights - (products @ moved[:, :, None])[..., 0]) / degree
    return moved


def face_normals(vertices: Vertices, faces: Faces) -> tuple[Doubles, Doubles]:
    """Unit normals (f, 3), 0 for faces without area, and areas (f,)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, np.finfo(float).tiny)[:, None], length / 2


def neighbours_across_edges(vertices: Vertices, faces: Faces) -> NDArray[np.int64]:
    """The face (f, 3) across each edge of a face, -1 at borders and where more than two faces meet."""
    key = edge_keys(vertices, faces)
    order = np.argsort(key, kind="stable")
    _, start, count = np.unique(key[order], return_index=True, return_counts=True)
    first = start[count == 2]
    one, other = order[first], order[first + 1]
    out = np.full(key.shape, -1, np.int64)
    out[one], out[other] = other // 3, one // 3
    return out.reshape(-1, 3)
