"""View dependence of surface brightness: evidence that an object is diffuse.

A Lambertian surface point has the same radiance in all directions, so all photos show it equally bright up to one exposure per photo.
Specular highlights, reflections and a light that moves with the camera break this. The test looks for brightening: a highlight may be
narrow, so that few photos show it, but these show the point much brighter than the median photo does.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera
from gsbake.imaging.sampling import bilinear_at_pixels
from gsbake.imaging.srgb import LUMINANCE, decode_bytes

#: A point is view-dependent when this quantile of its brightness exceeds the median by this share.
BRIGHTENING_THRESHOLD, BRIGHT_QUANTILE = 0.15, 0.95
#: Share of view-dependent points that a diffuse object may have: silhouettes and edges that are a pixel off.
MAX_VIEW_DEPENDENT_SHARE = 0.08
#: Below this compared share of the object, or below this number of points, the evidence is insufficient.
MIN_COVERED_SHARE, MIN_POINTS = 0.5, 200
#: Photos that must show a point for it to be compared.
MIN_VIEWS = 4
#: sRGB code up to which a pixel is too dark to compare.
MIN_CODE = 12
#: Standard deviation of the Gaussian blur before comparison, in pixels: about the accuracy of poses.
BLUR_SIGMA = 1.0
_MEDIAN_ITERATIONS = 10


@dataclass(frozen=True)
class BrightnessStatistics:
    """Change of brightness over the photos: number of `points` compared, median number of `views` per point, `median_increase` of a
    point's brightness (relative), `view_dependent_share` of points that brighten by more than BRIGHTENING_THRESHOLD."""

    points: int
    views: float
    median_increase: float
    view_dependent_share: float


class SurfaceBrightness:
    """Log brightness of the surface `points` (k, 3) in photos that are added one by one."""

    def __init__(self, points: Array) -> None:
        self.points = points
        self._rows: list[NDArray[np.float64]] = []

    def add(self, camera: Camera, rgb: NDArray[np.uint8], visible: NDArray[np.bool_]) -> None:
        """Add one photo (h, w, 3) sRGB of `camera`, in which the points `visible` (k,) are visible; points at its border are skipped."""
        row = np.full(len(self.points), np.nan)
        pixel, _ = camera.project(self.points)
        index = np.flatnonzero(visible & (pixel > 1).all(1) & (pixel[:, 0] < camera.width - 1) & (pixel[:, 1] < camera.height - 1))
        if len(index):
            value = sample_luminance(decode_bytes(rgb), pixel[index], BLUR_SIGMA)
            brightest_channel = cv2.GaussianBlur(rgb.max(2), (0, 0), BLUR_SIGMA)
            code = bilinear_at_pixels(brightest_channel, *(pixel[index].T - 0.5))
            valid = (code > MIN_CODE) & (value > 0)
            row[index[valid]] = np.log(value[valid])
        self._rows.append(row)

    def statistics(self) -> BrightnessStatistics:
        """Compare the photos added so far; without comparable points, `points` is 0 and the shares are NaN."""
        table = np.stack(self._rows) if self._rows else np.zeros((0, len(self.points)))
        table = table[:, np.isfinite(table).sum(0) >= MIN_VIEWS]
        if table.shape[1] == 0:
            return BrightnessStatistics(0, 0.0, math.nan, math.nan)
        residual = table - exposure_offsets(table)[:, None]
        increase = np.expm1(np.nanquantile(residual, BRIGHT_QUANTILE, axis=0) - np.nanmedian(residual, 0))
        views = float(np.median(np.isfinite(table).sum(0)))
        return BrightnessStatistics(table.shape[1], views, float(np.median(increase)), float((increase > BRIGHTENING_THRESHOLD).mean()))


def sample_luminance(linear: NDArray[np.float32], pixel: Array, blur_sigma: float) -> NDArray[np.float64]:
    """Luminance (n,) of a linear image (h, w, 3) at pixel positions (n, 2), after a Gaussian blur of `blur_sigma` pixels."""
    smooth = cv2.GaussianBlur(linear @ LUMINANCE, (0, 0), blur_sigma)
    return bilinear_at_pixels(smooth, *(pixel.T - 0.5)).astype(np.float64)


def exposure_offsets(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """One offset per photo (n,) of log brightness (n, k; NaN where not visible), by alternating medians; the median offset is 0."""
    offset = np.zeros(len(table))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a photo that shows no point has no median
        for _ in range(_MEDIAN_ITERATIONS):
            point = np.nanmedian(table - offset[:, None], 0)
            offset = np.nan_to_num(np.nanmedian(table - point, 1))
            offset -= np.median(offset)
    return offset


def is_diffuse(statistics: BrightnessStatistics, covered: float) -> tuple[bool, str]:
    """Whether the object is diffuse, and the evidence; `covered` is the share of the object that was compared."""
    if statistics.points < MIN_POINTS:
        return False, f"only {statistics.points} surface points could be compared"
    evidence = (
        f"{100 * statistics.view_dependent_share:.1f} % of {statistics.points} surface points brighten by more than "
        f"{100 * BRIGHTENING_THRESHOLD:.0f} % in some of about {statistics.views:.0f} photos, the median by "
        f"{100 * statistics.median_increase:.1f} %; {100 * covered:.0f} % of the object is compared"
    )
    return statistics.view_dependent_share <= MAX_VIEW_DEPENDENT_SHARE and covered >= MIN_COVERED_SHARE, evidence
