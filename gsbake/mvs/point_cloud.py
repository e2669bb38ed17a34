"""Fused point cloud: oriented, coloured, with pixel size and confidence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.ply import read_points, write_points

Array = NDArray[np.float64]

#: Record of one point in the PLY file.
RECORD = np.dtype(
    [("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3), ("radius", "<f4"), ("confidence", "<f4"), ("views", "u1")]
)


@dataclass(frozen=True)
class StereoCloud:
    """Oriented points in the unit frame.

    `points` (n, 3), `normals` (n, 3) unit and outward, `colours` (n, 3) 8-bit sRGB, `radius` (n,) of the pixel's footprint,
    `confidence` (n,) in 0..1, number of consistent `views` (n,).
    """

    points: Array
    normals: Array
    colours: NDArray[np.uint8]
    radius: Array
    confidence: Array
    views: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> StereoCloud:
        """The points at `index` (indices or a mask)."""
        return StereoCloud(
            self.points[index], self.normals[index], self.colours[index], self.radius[index], self.confidence[index], self.views[index]
        )

    def save(self, path: Path) -> None:
        """Write as PLY."""
        rows = np.zeros(len(self), RECORD)
        rows["position"], rows["normal"], rows["colour"] = self.points, self.normals, self.colours
        rows["radius"], rows["confidence"], rows["views"] = self.radius, self.confidence, self.views
        write_points(path, rows)

    @staticmethod
    def load(path: Path) -> StereoCloud:
        """Read what `save` wrote. Raises ValueError for any other PLY."""
        rows = read_points(path, RECORD)
        wide = {k: rows[k].astype(np.float64) for k in ("position", "normal", "radius", "confidence")}
        colours, views = rows["colour"].copy(), rows["views"].copy()
        return StereoCloud(wide["position"], wide["normal"], colours, wide["radius"], wide["confidence"], views)
