"""Decimation of the dense mesh to a low-poly mesh under an error bound.

The error is the deviation of the two surfaces: the distances of the vertices and face centres of either mesh to the other's surface.
Their maximum depends on single vertices, such as the tip of a spike; the bound is on their 99.9 % quantile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsbake.geometry.surface_distance import surface_distances
from gsbake.meshing.cleanup import Faces, Topology, Vertices, remove_small_components, topology
from gsbake.meshing.decimator_choice import Decimator
from gsbake.meshing.decimators import decimate
from gsbake.meshing.repair import close_holes, repair
from gsbake.meshing.untangling import untangle

#: Quantile of the distances that the bound applies to.
QUANTILE = 0.999
#: Minimum and maximum factor between the face counts of two attempts, and maximum number of attempts above the first face count.
MIN_FACTOR, MAX_FACTOR, MAX_RETRIES = 1.25, 2.0, 3
#: Deviation falls with the face count to about this power (measured: 0.63 to 0.99 on dense meshes of 160 000 to 1 000 000 faces).
DEVIATION_EXPONENT = 0.75
#: Share of the bound in the estimate of the next face count: an error of the estimate must not cost another retry.
SAFETY_FACTOR = 0.95
#: Maximum boundary edges of a hole that the repair of a decimated mesh leaves and that is filled again.
MAX_HOLE_EDGES = 100
#: Area of a piece that the repair cut off, as a share of the largest one, below which it is removed (measured: 4 to 8 faces, 1e-5 to 1e-4).
MIN_PIECE = 1e-3


@dataclass(frozen=True)
class Deviation:
    """Distances between two surfaces: the larger one of the two sides' 99.9 % quantiles, and the maximum; in units of the meshes."""

    quantile: float
    maximum: float


@dataclass(frozen=True)
class DecimatedMesh:
    """The low-poly mesh with its topology, its deviation from the dense mesh, and the number of `retries` above the first face count."""

    vertices: Vertices
    faces: Faces
    topology: Topology
    deviation: Deviation
    retries: int


def surface_deviation(first: tuple[Vertices, Faces], second: tuple[Vertices, Faces]) -> Deviation:
    """Deviation of two meshes, each `vertices` (v, 3) and `faces` (f, 3), from the vertices and face centres of both; inf when one is
    empty."""
    sides = [
        surface_distances(np.concatenate([vertices, vertices[faces].mean(1)]), *other)
        for (vertices, faces), other in ((first, second), (second, first))
    ]
    if not all(np.isfinite(side).all() and len(side) for side in sides):  # one of the meshes is empty
        return Deviation(np.inf, np.inf)
    return Deviation(max(float(np.quantile(side, QUANTILE)) for side in sides), max(float(side.max()) for side in sides))


def decimate_to_error_bound(
    vertices: Vertices,
    faces: Faces,
    target: int,
    max_target: int,
    max_error: float,
    decimator: Decimator,
    check_stop: Callable[[], None] = lambda: None,
) -> DecimatedMesh:
    """Decimate to `target` faces, or to more, at most `max_target`, until the deviation is at most `max_error` (units of the mesh).

    `max_error` 0 sets no bound. The bound can be missed at `max_target` faces or after `MAX_RETRIES` retries. `check_stop` is called before
    each retry.
    """
    retries, closed = 0, topology(vertices, faces).border_edges == 0
    while True:
        low_poly = decimate(vertices, faces, target, decimator)
        mesh_topology = topology(*low_poly)
        if low_poly[1] is not faces:
            if mesh_topology.non_manifold_edges:
                low_poly = _repaired(*low_poly, close=closed)
            low_poly = untangle(*low_poly, rings=0)  # crossings only: the walls of a rib are few faces wide
            mesh_topology = topology(*low_poly)
        deviation = Deviation(0.0, 0.0) if len(faces) <= target else surface_deviation((vertices, faces), low_poly)
        exceeded = 0 < max_error < deviation.quantile
        if not exceeded or target >= max_target or retries == MAX_RETRIES:
            return DecimatedMesh(*low_poly, mesh_topology, deviation, retries)
        check_stop()
        factor = (deviation.quantile / (SAFETY_FACTOR * max_error)) ** (1 / DEVIATION_EXPONENT)
        target = int(np.ceil(min(max_target, target * min(max(factor, MIN_FACTOR), MAX_FACTOR))))
        retries += 1


def _repaired(vertices: Vertices, faces: Faces, close: bool) -> tuple[Vertices, Faces]:
    """The manifold mesh without the pieces that were cut off; `close`: without the holes of the repair."""
    vertices, faces = repair(vertices, faces)
    if close:
        vertices, faces = close_holes(vertices, faces, MAX_HOLE_EDGES)
    return remove_small_components(vertices, faces, MIN_PIECE)[:2]
