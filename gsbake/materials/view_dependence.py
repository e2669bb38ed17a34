"""Whether the finished surface looks the same from everywhere: photos compared at places of the mesh that they see.

Unlike stereo's points, which are there only where photos match, these places are anywhere on the object: what shines speaks too.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import View
from gsbake.capture.view_dependence import Changes, Sightings
from gsbake.geometry.cameras import Array, Camera
from gsbake.geometry.raycast import RayCaster

#: About this many places tell.
PLACES = 6000
#: A place is compared in photos that look at it within about 70 degrees of its normal, and this many pixels inside the mask.
FACING, RIM = 0.35, 2
#: Rays start this share of the object's diagonal above the surface.
ABOVE = 2e-3


def seen_on_mesh(
    camera: Camera, mask: NDArray[np.uint8] | None, points: Array, normals: Array, caster: RayCaster, diagonal: float
) -> NDArray[np.bool_]:
    """Which places (k, 3) with outward `normals` (k, 3) face `camera`, lie in its `mask` (h, w) and are hidden by nothing."""
    seen = caster.seen_from(camera, points, normals, FACING, ABOVE * diagonal)
    if mask is not None:
        inner = cv2.erode(mask, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8))
        column, row = np.floor(camera.project(points[seen])[0]).astype(np.int64).T
        seen[np.flatnonzero(seen)] = inner[row, column] > 127
    return seen


class MeshWatch:
    """How the colours at `points` (k, 3; on the mesh of `caster`) with outward `normals` (k, 3) change over photos added one by one."""

    def __init__(self, points: NDArray[Any], normals: NDArray[Any], caster: RayCaster, diagonal: float) -> None:
        self._sightings = Sightings(np.asarray(points, np.float64))
        self._outward = np.asarray(normals, np.float64)
        self._caster, self._diagonal = caster, diagonal

    def add(self, view: View) -> None:
        """One more photo."""
        places = self._sightings.points
        seen = seen_on_mesh(view.camera, view.mask, places, self._outward, self._caster, self._diagonal)
        self._sightings.add(view.camera, view.rgb, seen)

    def changes(self) -> tuple[Changes, float]:
        """What changes, and the share of points compared."""
        changes = self._sightings.changes()
        return changes, changes.places / max(1, len(self._outward))
