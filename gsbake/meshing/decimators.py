"""Quadric edge collapse to a number of faces, by one of two libraries (`mesh.decimator`), and remeshing with edges of one length.

Garland & Heckbert, *Surface simplification using quadric error metrics*, SIGGRAPH 1997. pymeshlab, which is under the GPL, is imported in
this module only, and only when it decimates. fast-simplification, under the MIT licence, takes its place where it is not installed:
collapses in passes of rising error instead of a queue, boundaries kept. It does not check the topology of a collapse; the caller repairs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbake.errors import UsageError
from gsbake.meshing.cleanup import Faces, Vertices, remove_unused_vertices
from gsbake.meshing.decimator_choice import Decimator

#: Aggressiveness of fast-simplification, in turn until the number of faces is reached: lower is closer to the surface, but may stop early.
AGGRESSIVENESS = (3.0, 5.0, 7.0)
#: Diagonal of the mesh that each library gets, to within a factor of √2: their thresholds are absolute. For fast-simplification it was
#: measured best among 1, 10 and 100; for pymeshlab it is about that of the unit frame.
DIAGONAL: dict[Decimator, float] = {"pymeshlab": 2.0, "fast-simplification": 10.0}

#: Weight of the planes perpendicular to the faces beside those of the faces, for pymeshlab. Its own, 1e-3, outweighs the shape of a dense
#: mesh: of one of 421 000 faces, reduced to 22 500, the 99.9 % quantile of the deviation was then 2.7 times that of 3e-5.
PLANAR_WEIGHT = 3e-5
#: Diagonal of a mesh over its distance from the origin, below which it is a point.
MIN_EXTENT = 1e-12


def decimate(vertices: Vertices, faces: Faces, target: int, decimator: Decimator) -> tuple[Vertices, Faces]:
    """About `target` faces; boundaries and normals are kept.

    A mesh with fewer faces is returned as it is; of one that is a point, or nearly flat beside so few faces, nothing may be left.
    """
    if len(faces) <= target:
        return vertices, faces
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not diagonal > MIN_EXTENT * np.abs(vertices).max():
        return vertices[:0], faces[:0]
    scale = 2.0 ** np.round(np.log2(DIAGONAL[decimator]) - np.log2(diagonal))  # a power of two: exact
    reduce = _pymeshlab if decimator == "pymeshlab" else _fast_simplification
    low_vertices, low_faces = reduce(vertices * scale, faces, target)
    return low_vertices / scale, low_faces


def _mesh_set(vertices: Vertices, faces: Faces) -> Any:
    """A MeshSet of pymeshlab with this mesh."""
    try:
        import pymeshlab
    except ImportError as error:  # installed, but a system library is missing
        raise UsageError(
            f"pymeshlab does not load ({error}); `gsbake doctor` says what it needs, or set mesh.decimator to fast-simplification."
        ) from error
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)))
    return meshes


def _pymeshlab(vertices: Vertices, faces: Faces, target: int) -> tuple[Vertices, Faces]:
    meshes = _mesh_set(vertices, faces)
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(target),
        qualitythr=0.3,
        preserveboundary=True,
        boundaryweight=2.0,
        preservenormal=True,
        preservetopology=True,
        optimalplacement=True,
        planarquadric=True,  # avoids slivers on flat surfaces
        planarweight=PLANAR_WEIGHT,
        autoclean=True,
    )
    mesh = meshes.current_mesh()
    return remove_unused_vertices(np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int32).reshape(-1, 3))


def _fast_simplification(vertices: Vertices, faces: Faces, target: int) -> tuple[Vertices, Faces]:
    from fast_simplification import simplify

    out = (vertices, faces)
    for aggressiveness in AGGRESSIVENESS:
        out = simplify(vertices, faces, target_count=int(target), agg=aggressiveness, preserve_border=True)
        if len(out[1]) <= target:
            break
    return remove_unused_vertices(np.asarray(out[0], np.float64), np.asarray(out[1], np.int32))


def remesh(vertices: Vertices, faces: Faces, edge: float, most: int, decimator: Decimator) -> tuple[Vertices, Faces]:
    """The surface with edges of about the length `edge`, by pymeshlab (Botsch & Kobbelt, *A remeshing approach to multiresolution
    modeling*, SGP 2004); where that is not installed the mesh itself, decimated to about `most` vertices where it has more."""
    if len(faces) == 0 or not edge > 0:
        return vertices, faces
    if decimator != "pymeshlab":
        return (vertices, faces) if len(vertices) <= most else decimate(vertices, faces, max(4, 2 * most), decimator)
    scale = 1 / edge
    meshes = _mesh_set(vertices * scale, faces)
    import pymeshlab

    meshes.meshing_isotropic_explicit_remeshing(
        iterations=3, targetlen=pymeshlab.PureValue(1.0), adaptive=False, checksurfdist=False, featuredeg=40
    )
    mesh = meshes.current_mesh()
    found, corners = np.asarray(mesh.vertex_matrix(), np.float64), np.asarray(mesh.face_matrix(), np.int32).reshape(-1, 3)
    low, low_faces = remove_unused_vertices(found, corners)
    return low / scale, low_faces
