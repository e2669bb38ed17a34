"""Exposure of the photos against each other, told by the tie points of structure from motion.

A tie point was matched because it looks the same in its photos, and most lie on the matt, textured things around an object. So their
brightness changes with the exposure alone, where a shining object's own surface also changes with the side it is seen from: on polished
metal the photos differ by half without any change of exposure.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.poses.colmap_model import read_tracks
from gsbake.capture.view_dependence import exposures, luminance_at
from gsbake.geometry.cameras import Camera, Similarity

#: Blur (pixels) before photos are compared: keypoints sit on corners.
BLUR = 2.0
#: Linear values outside this range are noise or clipped.
RANGE = (0.01, 0.9)
#: A point counts when this many photos show it, a photo when it shows this many points; fewer points in all say nothing.
LEAST_PHOTOS, LEAST_POINTS, LEAST_IN_ALL = 3, 30, 200
#: Share of the photos that the answer holds for: one that shares few points with the others may be off.
MOST = 0.9


class TiePoints:
    """What photos show at tie points; add the photos one by one."""

    def __init__(self, points: NDArray[np.float64], seen: dict[str, NDArray[np.int64]]) -> None:
        """`points` (k, 3) in the frame of the cameras; `seen` holds the points' indices by the name of the photo."""
        self._points, self._seen = points, seen
        self._rows: list[NDArray[np.float64]] = []

    @classmethod
    def of(cls, folder: Path, to_frame: Similarity) -> TiePoints | None:
        """Those of the COLMAP model in `folder`, mapped by the similarity `to_frame`; None when there is no model."""
        if not (folder / "points3D.bin").exists():
            return None
        points, seen = read_tracks(folder)
        return cls(to_frame.apply(points), seen)

    def add(self, camera: Camera, linear: NDArray[np.float32]) -> None:
        """One undistorted photo (h, w, 3), linear, of `camera`."""
        row = np.full(len(self._points), np.nan)
        index = self._seen.get(camera.name, np.zeros(0, np.int64))
        if len(index):
            pixel, depth = camera.project(self._points[index])
            inside = (depth > 0) & (pixel > 2).all(1) & (pixel[:, 0] < camera.width - 2) & (pixel[:, 1] < camera.height - 2)
            index, pixel = index[inside], pixel[inside]
        if len(index):
            value = luminance_at(linear, pixel, BLUR)
            good = (value > RANGE[0]) & (value < RANGE[1])
            row[index[good]] = np.log(value[good])
        self._rows.append(row)

    def spread(self) -> float | None:
        """Factor within which `MOST` of the photos' exposures lie; None when there are too few points to say."""
        table = np.stack(self._rows) if self._rows else np.zeros((0, len(self._points)))
        table = table[:, np.isfinite(table).sum(0) >= LEAST_PHOTOS]
        table = table[np.isfinite(table).sum(1) >= LEAST_POINTS]
        if table.shape[1] < LEAST_IN_ALL or len(table) < LEAST_PHOTOS:
            return None
        return float(np.exp(np.quantile(np.abs(exposures(table)), MOST)))
