"""Outlier components of the point cloud: mirror images on specular surfaces, and chance matches.

Specular reflections match as well as texture does, at the depth of the mirror image. Such a component is isolated deep inside the visual
hull, while a true concavity is connected to its boundary. Tiny isolated components are chance matches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Array
from gsbake.mvs.depth_maps import DepthMap
from gsbake.mvs.point_cloud import StereoCloud

#: Cell edge for connected components: this many median point radii, clamped (unit frame).
CELL_SPACINGS, MIN_CELL, MAX_CELL = 5.0, 0.01, 0.05
#: A component with a smaller share of the points is a chance match.
MIN_COMPONENT_SHARE = 0.002
#: A component with a smaller share, whose median depth in the hull exceeds this many cells, is a mirror image.
MAX_MIRROR_SHARE, MIN_MIRROR_DEPTH = 0.2, 5.0
#: Half edge of the grid around the origin.
HALF_EXTENT = 1.1


@dataclass(frozen=True)
class OutlierComponents:
    """Cells (n, n, n) of edge `cell`, from −HALF_EXTENT on, that contain outliers, and the number of outlier points."""

    cells: NDArray[np.bool_]
    cell: float
    points: int

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 3) are outliers."""
        return np.asarray(self.cells[tuple(_index(points, self.cell, self.cells.shape[0]).T)])


def _index(points: Array, cell: float, count: int) -> NDArray[np.int64]:
    return np.clip(np.floor((points + HALF_EXTENT) / cell), 0, count - 1).astype(np.int64)


def find_outliers(cloud: StereoCloud, hull: Hull | None) -> OutlierComponents:
    """The outlier components of the cloud; mirror images are found only with a hull."""
    typical = float(np.median(cloud.radius)) if len(cloud) else MIN_CELL
    cell = float(np.clip(CELL_SPACINGS * typical, MIN_CELL, MAX_CELL))
    count = int(np.ceil(2 * HALF_EXTENT / cell))
    full = np.zeros((count, count, count), bool)
    index = _index(cloud.points, cell, count)
    full[tuple(index.T)] = True
    label, n_components = ndimage.label(full, structure=np.ones((3, 3, 3)))
    point_label = label[tuple(index.T)]
    size = np.bincount(point_label, minlength=n_components + 1)
    drop = size < MIN_COMPONENT_SHARE * len(cloud)
    if hull is not None:
        depth = -hull.signed_distance(cloud.points) / hull.cell
        for component in np.flatnonzero((size < MAX_MIRROR_SHARE * len(cloud)) & ~drop):
            drop[component] = np.median(depth[point_label == component]) > MIN_MIRROR_DEPTH
    drop[0] = False
    return OutlierComponents(drop[label], cell, int(drop[point_label].sum()))


def without_points(one: DepthMap, wrong: Callable[[Array], NDArray[np.bool_]]) -> DepthMap:
    """The depth map without the pixels whose points are `wrong`."""
    return one.select(~wrong((one.camera_points() - one.camera.t) @ one.camera.R))
