"""Exposure differences between photos: as EXIF has them, and measured at the tie points of structure from motion.

Tie points match because they look the same in their photos, and most lie on the diffuse, textured surroundings of the object. Their
brightness therefore changes with the exposure alone. The surface of a specular object also changes with the viewing direction: on smooth
metal photos of equal exposure differ by half.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.poses.colmap_model import read_tracks
from gsbake.capture.view_dependence import exposure_offsets, sample_luminance
from gsbake.geometry.cameras import Camera, Similarity

#: Standard deviation of the Gaussian blur before comparison, in pixels: keypoints lie on corners.
BLUR_SIGMA = 2.0
#: Linear values outside this range are noise or clipped.
VALUE_RANGE = (0.01, 0.9)
#: Photos that must show a point, points that a photo must show, and points in all that a result needs.
MIN_VIEWS, MIN_POINTS_PER_PHOTO, MIN_POINTS = 3, 30, 200
#: Quantile of the photos' exposure offsets that is returned: a photo that shares few points with the others may be an outlier.
SPREAD_QUANTILE = 0.9
#: Photos whose spread is below this factor have one exposure: tie points are rarely specular.
MAX_SPREAD = 1.15


def written_exposures(entries: Sequence[Mapping[str, Any]]) -> NDArray[np.float64] | None:
    """Logarithms (photos,) of the exposures by EXIF, of mean 0, of photos with these `entries` of photos.json.

    None where a photo has none, where cameras or focal lengths differ, whose constants are unknown, and where a flash fired: EXIF does not
    measure its light.
    """
    if not entries or any(not entry.get("light_exposure") or entry["flash"] for entry in entries):
        return None
    if len({(entry["camera_model"], entry["camera_body"]) for entry in entries}) > 1:
        return None
    logs = np.log([entry["light_exposure"] for entry in entries])
    return np.asarray(logs - logs.mean())


class TiePointExposure:
    """Log brightness of tie points in photos that are added one by one."""

    def __init__(self, points: NDArray[np.float64], visible: dict[str, NDArray[np.int64]]) -> None:
        """`points` (k, 3) in the frame of the cameras; `visible` maps a photo's name to the indices of the points it shows."""
        self._points, self._visible = points, visible
        self._rows: list[NDArray[np.float64]] = []

    @classmethod
    def from_model(cls, folder: Path, to_frame: Similarity) -> TiePointExposure | None:
        """The tie points of the COLMAP model in `folder`, mapped by the similarity `to_frame`; None when there is no model."""
        if not (folder / "points3D.bin").exists():
            return None
        points, visible = read_tracks(folder)
        return cls(to_frame.apply(points), visible)

    def add(self, camera: Camera, linear: NDArray[np.float32]) -> None:
        """Add one undistorted linear photo (h, w, 3) of `camera`."""
        row = np.full(len(self._points), np.nan)
        index = self._visible.get(camera.name, np.zeros(0, np.int64))
        if len(index):
            pixel, depth = camera.project(self._points[index])
            inside = (depth > 0) & (pixel > 2).all(1) & (pixel[:, 0] < camera.width - 2) & (pixel[:, 1] < camera.height - 2)
            index, pixel = index[inside], pixel[inside]
        if len(index):
            value = sample_luminance(linear, pixel, BLUR_SIGMA)
            valid = (value > VALUE_RANGE[0]) & (value < VALUE_RANGE[1])
            row[index[valid]] = np.log(value[valid])
        self._rows.append(row)

    def spread(self) -> float | None:
        """Factor within which the exposures of SPREAD_QUANTILE of the photos lie; None when there are too few points."""
        table = np.stack(self._rows) if self._rows else np.zeros((0, len(self._points)))
        table = table[:, np.isfinite(table).sum(0) >= MIN_VIEWS]
        table = table[np.isfinite(table).sum(1) >= MIN_POINTS_PER_PHOTO]
        if table.shape[1] < MIN_POINTS or len(table) < MIN_VIEWS:
            return None
        return float(np.exp(np.quantile(np.abs(exposure_offsets(table)), SPREAD_QUANTILE)))
