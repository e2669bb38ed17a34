"""Untangling: no face crosses another one or lies inside out, with as little of the surface moved as possible.

Displacements fold a mesh over itself: at rims, in narrow gaps, where two evidences disagree by more than an edge. A face is *tangled* where
it crosses another face, or where its normal and the mean normal of the faces around it are more than 90° apart. Regions of tangled faces
are replaced by the membrane over their boundary (uniform Laplace equation: the embedding of Tutte, *How to draw a graph*, 1963, which has
no folds over a convex boundary), and grow by a ring of faces where that does not help. What is still tangled then has the wrong topology,
such as a handle thinner than a face: it is cut out, and the holes are filled with least area (as Attene, *A lightweight approach to
repairing digitized polygon meshes*, The Visual Computer 2010, does).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from gsbake.geometry.self_intersection import self_intersecting_faces
from gsbake.kernels.declaration import kernel
from gsbake.meshing.cleanup import Faces, Vertices, edge_keys, face_components, remove_unused_vertices
from gsbake.meshing.refinement.normal_filter import face_normals, neighbours_across_edges
from gsbake.meshing.repair import boundary_loops, fill_hole

Mask = NDArray[np.bool_]

#: Rings of faces over which normals are averaged: wider than the folds of a dense mesh that no crossing gives away, and narrower than the
#: ribs and grooves of marching cubes, whose walls look past the mean normal.
RINGS = 4
#: Membranes before a region is cut out, and most attempts of both.
MEMBRANES, ATTEMPTS = 3, 8
#: Most rings of faces around a tangled region that are cut out with it.
MAX_CUT = 4
#: Area of a piece that a cut leaves, as a share of the largest one of the same component, below which it is removed.
MIN_PIECE = 1e-3
#: Most boundary edges of a hole that a cut leaves and that is filled.
MAX_HOLE_EDGES = 400


def inside_out_faces(vertices: Vertices, faces: Faces, rings: int = RINGS) -> Mask:
    """Which faces (f,) point away from the mean normal, by area, of the faces within about `rings` rings around them; none with 0
    rings."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    largest = float(np.abs(normals).max(initial=0))
    if not largest > 0:
        return np.zeros(len(faces), np.bool_)
    normals /= largest
    return np.asarray((normals * _mean_normals(np.ascontiguousarray(faces, np.int32), normals, len(vertices), rings)).sum(1) < 0)


def tangled_faces(vertices: Vertices, faces: Faces, rings: int = RINGS, among: Mask | None = None) -> Mask:
    """Which faces (f,) cross another one, of which one is `among` (f,) these, or lie inside out."""
    return self_intersecting_faces(vertices, faces, among) | inside_out_faces(vertices, faces, rings)


def untangle(vertices: Vertices, faces: Faces, start: Vertices | None = None, rings: int = RINGS) -> tuple[Vertices, Faces]:
    """The mesh without tangled faces; what is not tangled keeps its place, boundaries stay open, and a closed mesh stays closed.

    `vertices` (v, 3) and `faces` (f, 3) are manifold and oriented, and stay so. A component of which most is tangled stays so;
    a mesh that would not get better is returned as it is.
    `start` (v, 3): where the vertices were before they were displaced. The displacements of tangled regions then become smooth first, so
    that the surface keeps the shape that it had there.
    """
    touched = np.ones(len(vertices), np.bool_)  # vertices of faces that may cross another one
    given = vertices, faces
    if start is not None:
        vertices, _, touched = _with_membranes(vertices, faces, touched, rings, start)
    for attempt in range(ATTEMPTS):
        vertices, tangled, touched = _with_membranes(vertices, faces, touched, rings)
        if not tangled.any():
            return vertices, faces
        if attempt == ATTEMPTS - 1:
            break
        for growth in range(min(attempt, MAX_CUT), MAX_CUT + 1):
            cut = _cut_out(vertices, faces, tangled, growth)
            if cut is not None:
                vertices, faces, touched = cut
                break
        else:
            break
    before, after = (int(tangled_faces(*mesh, rings).sum()) for mesh in (given, (vertices, faces)))
    return (vertices, faces) if after < before else given


def _with_membranes(
    vertices: Vertices, faces: Faces, touched: Mask, rings: int, start: Vertices | float = 0.0
) -> tuple[Vertices, Mask, Mask]:
    """Vertices after some membranes over the tangled regions, of the displacements from `start` (v, 3), the faces (f,) that are still
    tangled, and their vertices (v,)."""
    region = np.zeros(len(vertices), np.bool_)
    for step in range(MEMBRANES + 1):
        tangled = tangled_faces(vertices, faces, rings, np.asarray(touched[faces].any(1)))
        seeds = np.zeros(len(vertices), np.bool_)
        seeds[faces[tangled]] = True
        if step == MEMBRANES or not tangled.any():
            break
        grown = seeds if step == 0 else _grown(seeds | _parts_near(region, seeds, faces), faces)
        vertices = np.where(grown[:, None], start + _membrane(vertices - start, faces, grown), vertices)
        touched, region = seeds | grown, region | grown
    return vertices, tangled, seeds


def _grown(mask: Mask, faces: Faces) -> Mask:
    """The vertices (v,) of all faces with a vertex in `mask` (v,)."""
    out = mask.copy()
    out[faces[mask[faces].any(1)]] = True
    return out


def _parts_near(region: Mask, seeds: Mask, faces: Faces) -> Mask:
    """Vertices (v,) of the connected parts of `region` that have one of `seeds`, or a neighbour of one."""
    links = faces[region[faces].sum(1) > 1]
    a, b = links.ravel(), links[:, [1, 2, 0]].ravel()
    both = region[a] & region[b]
    graph = sparse.coo_matrix((np.ones(both.sum(), np.int8), (a[both], b[both])), shape=(len(region), len(region)))
    part = connected_components(graph, directed=False)[1]
    return np.asarray(region & np.isin(part, part[region & _grown(seeds, faces)]))


def _membrane(values: Vertices, faces: Faces, free: Mask) -> Vertices:
    """Values (v, 3) at the vertices, of which those `free` (v,) are the means of their neighbours; parts without a fixed neighbour stay."""
    near = faces[free[faces].any(1)]
    start, end = near[:, [0, 1, 2, 1, 2, 0]].ravel(), near[:, [1, 2, 0, 0, 1, 2]].ravel()
    start, end = start[free[start]], end[free[start]]
    index = np.cumsum(free) - 1
    count = int(free.sum())
    inner = free[end]
    weights = sparse.coo_matrix((np.ones(inner.sum()), (index[start[inner]], index[end[inner]])), shape=(count, count)).tocsr()
    degree = np.bincount(index[start], minlength=count)
    sums = np.stack([np.bincount(index[start[~inner]], values[end[~inner], axis], count) for axis in range(3)], 1)
    part = connected_components(weights, directed=False)[1]
    anchored = np.isin(part, part[np.bincount(index[start[~inner]], minlength=count) > 0])
    out = values.copy()
    if anchored.any():
        laplacian = (sparse.diags(degree.astype(float)) - weights)[anchored][:, anchored]
        out[np.flatnonzero(free)[anchored]] = splu(laplacian.tocsc()).solve(sums[anchored])
    return out


def _cut_out(vertices: Vertices, faces: Faces, tangled: Mask, growth: int) -> tuple[Vertices, Faces, Mask] | None:
    """The mesh with `tangled` faces (f,) and `growth` rings around them replaced by fillings, and the vertices (v,) of these; None where a
    hole cannot be filled, and where most of each component would be replaced."""
    region = np.zeros(len(vertices), np.bool_)
    region[faces[tangled]] = True
    for _ in range(growth):
        region = _grown(region, faces)
    cut: Mask = np.asarray(region[faces].all(1))
    neighbour = neighbours_across_edges(vertices, faces)
    pinched = np.zeros(0, np.int64)
    for _ in range(MAX_CUT):
        cut |= np.isin(faces, pinched).any(1)
        cut = _with_small_pieces(vertices, faces, cut)
        inner, corner = np.nonzero(cut[:, None] & (neighbour >= 0) & ~cut[neighbour])
        rim = np.stack([faces[inner, corner], faces[inner, (corner + 1) % 3]], 1).astype(np.int64)
        starts, counts = np.unique(rim[:, 0], return_counts=True)
        pinched = starts[counts > 1]  # two holes meet there, and become one
        if len(pinched) == 0:
            break
    holes = boundary_loops(rim)
    if len(rim) == 0 or len(pinched) or max((len(hole) for hole in holes), default=0) > MAX_HOLE_EDGES:
        return None
    edges = np.unique(edge_keys(vertices, faces[np.isin(faces, rim).any(1) & ~cut]))
    patches = [fill_hole(vertices, hole, edges) for hole in holes]
    if not all(len(patch) for patch in patches):
        return None
    out = np.concatenate([faces[~cut], *patches])
    touched = np.zeros(len(vertices), np.bool_)
    touched[rim] = True
    used = np.unique(out)
    return *remove_unused_vertices(vertices, out), touched[used]


def _with_small_pieces(vertices: Vertices, faces: Faces, cut: Mask) -> Mask:
    """The faces (f,) to cut, with small pieces that would come loose, and without those of components of which most would go."""
    component, area = face_components(vertices, faces), face_normals(vertices, faces)[1]
    whole = np.bincount(component, area)
    piece = face_components(vertices, faces[~cut])
    out = cut.copy()
    out[~cut] = np.bincount(piece, area[~cut])[piece] < MIN_PIECE * whole[component[~cut]]
    return out & (np.bincount(component, area * out) < 0.5 * whole)[component]


@kernel("i4[:, ::1], f8[:, ::1], i8, i8", nogil=True)
def _mean_normals(faces: Any, normals: Any, count: Any, rings: Any) -> Any:
    """Sums (f, 3) of the `normals` (f, 3) of faces that share a vertex with each, `rings` times, over a mesh of `count` vertices."""
    out = normals.copy()
    sums = np.empty((count, 3))
    for _ in range(rings):
        sums[:] = 0
        for f in range(len(faces)):
            for k in range(3):
                for axis in range(3):
                    sums[faces[f, k], axis] += out[f, axis]
        for f in range(len(faces)):
            for axis in range(3):
                out[f, axis] = (sums[faces[f, 0], axis] + sums[faces[f, 1], axis] + sums[faces[f, 2], axis]) / 9
    return out
