"""Whether the finished surface looks the same from everywhere: photos compared at places of the mesh that they see.

Unlike stereo's points, which are there only where photos match, these places are anywhere on the object: what shines speaks too.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.cameras import Array, Camera
from gsbake.capture.posed import View
from gsbake.capture.steadiness import Changes, Sightings
from gsbake.surface.raycast import RayCaster

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
    pixel, z = camera.project(points)
    ray = camera.centre - points
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    seen = (z > 1e-6) & (pixel >= 0).all(1) & (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
    seen &= (ray * normals).sum(1) > FACING
    if mask is not None:
        inner = cv2.erode(mask, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8))
        column, row = np.floor(pixel[seen]).astype(np.int64).T
        seen[np.flatnonzero(seen)] = inner[row, column] > 127
    index = np.flatnonzero(seen)
    seen[index] = ~caster.occluded(points[index] + ABOVE * diagonal * normals[index], ray[index])
    return seen


def watch_mesh(
    points: NDArray[Any], normals: NDArray[Any], caster: RayCaster, diagonal: float, views: Iterable[View]
) -> tuple[Changes, float]:
    """How the colours at `points` (k, 3; on the mesh of `caster`) change over the photos, and the share of points compared."""
    sightings = Sightings(np.asarray(points, np.float64))
    outward = np.asarray(normals, np.float64)
    for view in views:
        sightings.add(view.camera, view.rgb, seen_on_mesh(view.camera, view.mask, sightings.points, outward, caster, diagonal))
    changes = sightings.changes()
    return changes, changes.places / max(1, len(points))
