"""Whether any of the object lies in a region, by the masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsbake.capture.hull.visual_hull import MAX_INCONSISTENT_SHARE
from gsbake.geometry.cameras import Camera
from gsbake.geometry.region import Region

#: Points along an edge of the box, and photos that must show a point.
POINTS, MIN_PHOTOS = 24, 3


def holds_object(region: Region, masks: Sequence[tuple[Camera, Any]]) -> bool:
    """Whether some point of the box lies inside the masks (h, w; 255: object) of nearly all photos that show it."""
    along = (np.arange(POINTS) + 0.5) / POINTS - 0.5
    grid = np.stack(np.meshgrid(along, along, along), -1).reshape(-1, 3)
    points = region.centre + (grid * region.size) @ region.rotation.T
    seen, inside = np.zeros(len(points)), np.zeros(len(points))
    for camera, mask in masks:
        pixel, depth = camera.project(points)
        shown = np.flatnonzero(camera.in_view(pixel, depth))
        column, row = np.floor(pixel[shown]).astype(np.int64).T
        seen[shown] += 1
        inside[shown] += np.asarray(mask)[row, column] > 127
    return bool(((seen >= MIN_PHOTOS) & (inside >= (1 - MAX_INCONSISTENT_SHARE) * seen)).any())
