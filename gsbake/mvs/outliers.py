"""Pieces of the cloud that are no surface: what is mirrored in gloss is matched as well as texture, at the mirror image's depth.

Such a piece hangs alone, deep under the visual hull, while a true concave place is joined to its rim. Tiny loose pieces are chance matches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Array
from gsbake.mvs.depth_maps import DepthMap
from gsbake.mvs.point_cloud import StereoCloud

#: Edge of the cells in which points are joined: this many typical point distances, within limits (unit frame).
CELL, LEAST_CELL, MOST_CELL = 5.0, 0.01, 0.05
#: A piece with less than this share of the points is a chance match.
TINY = 0.002
#: A piece with less than this share, whose middle lies deeper than this many hull cells, is a mirror image.
SMALL, DEEP = 0.2, 5.0
#: The grid covers this half edge around the origin.
HALF = 1.1


@dataclass(frozen=True)
class Ghosts:
    """Cells (n, n, n) of edge `cell` from −HALF on that hold pieces to drop, and how many points those were."""

    cells: NDArray[np.bool_]
    cell: float
    points: int

    def hold(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 3) lie in such a cell."""
        return np.asarray(self.cells[tuple(_index(points, self.cell, self.cells.shape[0]).T)])


def _index(points: Array, cell: float, count: int) -> NDArray[np.int64]:
    return np.clip(np.floor((points + HALF) / cell), 0, count - 1).astype(np.int64)


def find_ghosts(cloud: StereoCloud, hull: Hull | None) -> Ghosts:
    """The pieces of the cloud to drop."""
    typical = float(np.median(cloud.radius)) if len(cloud) else LEAST_CELL
    cell = float(np.clip(CELL * typical, LEAST_CELL, MOST_CELL))
    count = int(np.ceil(2 * HALF / cell))
    full = np.zeros((count, count, count), bool)
    index = _index(cloud.points, cell, count)
    full[tuple(index.T)] = True
    label, pieces = ndimage.label(full, structure=np.ones((3, 3, 3)))
    mine = label[tuple(index.T)]
    size = np.bincount(mine, minlength=pieces + 1)
    drop = size < TINY * len(cloud)
    if hull is not None:
        depth = -hull.signed_distance(cloud.points) / hull.cell
        for piece in np.flatnonzero((size < SMALL * len(cloud)) & ~drop):
            drop[piece] = np.median(depth[mine == piece]) > DEEP
    drop[0] = False
    return Ghosts(drop[label], cell, int(drop[mine].sum()))


def without_ghosts(one: DepthMap, ghosts: Ghosts) -> DepthMap:
    """The depth map without the pixels that show a ghost."""
    depth = one.depth()
    row, column = np.nonzero(depth > 0)
    if ghosts.points == 0 or not len(row):
        return one
    camera, z = one.camera, depth[row, column].astype(np.float64)
    local = np.stack([(column + 0.5 - camera.cx) / camera.fx * z, (row + 0.5 - camera.cy) / camera.fy * z, z], 1)
    bad = ghosts.hold((local - camera.t) @ camera.R)
    confidence, views = one.confidence.copy(), one.views.copy()
    confidence[row[bad], column[bad]] = 0
    views[row[bad], column[bad]] = 0
    return replace(one, confidence=confidence, views=views)
