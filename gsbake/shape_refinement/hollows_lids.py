"""Lids of hollows: smooth soft parts of a visual hull about whose colour the photos disagree, whatever they may reflect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsbake.capture.hull.softness import SOFT
from gsbake.capture.hull.visual_hull import Hull
from gsbake.shape_refinement.hollows_prediction import Prediction, diffuse_errors, reflected_errors
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.surface import Doubles, Faces, Surface

#: Cells along the edge of a block of which the hull's mesh is made.
BLOCK = 2
#: Photos disagree from this error on; it is averaged by so many half-steps over neighbours.
LEAST_ERROR, AVERAGING = 0.02, 6
#: Softness holds for this many cells around; normals are averaged by so many half-steps.
AROUND, NORMAL_AVERAGING = 5, 4
#: Neighbours whose normals have a smaller cosine belong to different parts: a lid ends at the rim.
SAME_PART = 0.95
#: Least vertices of a lid, the share of them that photos have to see, and the most lids that are tried, the largest first.
LEAST_VERTICES, SEEN_SHARE, MOST_LIDS = 40, 0.5, 6
#: Holes in a lid up to twice as many cells wide are closed.
CLOSING = 3


@dataclass(frozen=True)
class Lid:
    """A lid: its `cells` (n, n, n) on the hull's surface, number of `vertices`, and how it predicts as it is."""

    cells: NDArray[np.bool_]
    vertices: int
    prediction: Prediction


def surface_cells(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (n, n, n) of the solid with a neighbour outside."""
    return np.asarray(solid & ~ndimage.binary_erosion(solid))


def _blocks(hull: Hull) -> Hull:
    """The hull on blocks of cells; empty where it is thinner than one."""
    n = hull.field.shape[0] // BLOCK
    clipped = np.clip(hull.field, -4 * hull.cell, 4 * hull.cell)
    field = np.asarray(clipped.reshape(n, BLOCK, n, BLOCK, n, BLOCK).mean((1, 3, 5)), np.float32)
    return Hull(field < 0, hull.lower, BLOCK * hull.cell, field)


def hull_mesh(hull: Hull) -> tuple[Doubles, Faces]:
    """Vertices and faces of the hull on blocks of cells. Raises ValueError where it is thinner than one."""
    vertices, faces = _blocks(hull).triangles()
    return np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int32)


def find_lids(hull: Hull, softness: NDArray[np.float32], photos: Sequence[Photo]) -> Iterator[Lid]:
    """The lids of the hull, the largest first, none of one that is thinner than a block; `softness` (n, n, n) as from
    `surface_softness`."""
    if _blocks(hull).empty:
        return
    vertices, faces = hull_mesh(hull)
    surface = Surface(len(vertices), faces)
    errors = np.fmin(reflected_errors(vertices, faces, photos), diffuse_errors(vertices, faces, photos))
    known = np.isfinite(errors)
    total, count = surface.averaged(np.stack([np.where(known, np.minimum(errors, 1), 0), known], 1), AVERAGING).T
    disagree = total > LEAST_ERROR * np.maximum(count, 1e-3)
    soft = ndimage.maximum_filter(softness, AROUND)[hull.cells_of(vertices)] >= SOFT
    normals = surface.averaged(surface.normals(vertices), NORMAL_AVERAGING)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    possible = disagree & soft
    a, b = surface.edges.T
    joined = possible[a] & possible[b] & ((normals[a] * normals[b]).sum(1) > SAME_PART)
    graph = sparse.coo_matrix((np.ones(joined.sum()), (a[joined], b[joined])), (len(vertices), len(vertices)))
    number, part = connected_components(graph, directed=False)
    sizes = np.bincount(part[possible], minlength=number)
    shell = surface_cells(hull.occupancy)
    cells = np.argwhere(shell)
    nearest = cKDTree(vertices).query(hull.lower + (cells + 0.5) * hull.cell)[1]
    for index in np.argsort(-sizes, kind="stable")[:MOST_LIDS]:
        if sizes[index] < LEAST_VERTICES:
            return
        prediction = Prediction.of(errors[(part == index) & possible & known])
        if prediction.seen < SEEN_SHARE * sizes[index]:
            continue
        chosen = np.zeros(shell.shape, bool)
        chosen[tuple(cells[(part == index)[nearest] & possible[nearest]].T)] = True
        chosen = ndimage.binary_closing(chosen, np.ones((3, 3, 3)), CLOSING) & shell
        yield Lid(chosen, int(sizes[index]), prediction)
