"""View dependence measured on the final mesh: brightness of surface points over the photos that show them.

Stereo's points exist only where photos match; these are anywhere on the object, so specular areas count too.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import View
from gsbake.capture.view_dependence import BrightnessStatistics, SurfaceBrightness
from gsbake.geometry.cameras import Array, Camera
from gsbake.geometry.raycast import RayCaster

#: Surface points compared, about.
SURFACE_POINTS = 6000
#: Least cosine between a point's normal and the view (70 degrees), and least distance in pixels inside the mask.
MIN_COSINE, MASK_MARGIN = 0.35, 2
#: Rays start this share of the object's diagonal above the surface.
RAY_OFFSET = 2e-3


def visible_on_mesh(
    camera: Camera, mask: NDArray[np.uint8] | None, points: Array, normals: Array, caster: RayCaster, diagonal: float
) -> NDArray[np.bool_]:
    """Which `points` (k, 3) with outward `normals` (k, 3) face `camera`, lie in its `mask` (h, w) and are unoccluded."""
    visible = caster.visible_from(camera, points, normals, MIN_COSINE, RAY_OFFSET * diagonal)
    if mask is not None:
        inner = cv2.erode(mask, np.ones((2 * MASK_MARGIN + 1, 2 * MASK_MARGIN + 1), np.uint8))
        column, row = np.floor(camera.project(points[visible])[0]).astype(np.int64).T
        visible[np.flatnonzero(visible)] = inner[row, column] > 127
    return visible


class MeshBrightness:
    """Brightness of `points` (k, 3) on the mesh of `caster`, with outward `normals` (k, 3), in photos that are added one by one."""

    def __init__(self, points: NDArray[Any], normals: NDArray[Any], caster: RayCaster, diagonal: float) -> None:
        self._brightness = SurfaceBrightness(np.asarray(points, np.float64))
        self._normals = np.asarray(normals, np.float64)
        self._caster, self._diagonal = caster, diagonal

    def add(self, view: View) -> None:
        """Add one photo."""
        visible = visible_on_mesh(view.camera, view.mask, self._brightness.points, self._normals, self._caster, self._diagonal)
        self._brightness.add(view.camera, view.rgb, visible)

    def statistics(self) -> tuple[BrightnessStatistics, float]:
        """Statistics of the points compared, and their share of all points."""
        statistics = self._brightness.statistics()
        return statistics, statistics.points / max(1, len(self._normals))
