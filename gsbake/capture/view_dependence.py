"""Whether places of the surface look the same from everywhere: the evidence that an object is diffuse.

A diffuse place sends the same light in all directions (Lambert), so all photos show one brightness there, up to one exposure per photo.
Highlights, mirror images and a light that turns with the camera do not. What is looked for is brightening: a highlight may be narrow, so
that few photos show it, but those show the place much brighter than the others do.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera
from gsbake.imaging.sampling import read_at
from gsbake.imaging.srgb import decode_bytes

#: A place that its brightest photos (this quantile) show brighter than the median one by this share shines.
CHANGE, BRIGHT_PHOTOS = 0.15, 0.95
#: A diffuse object may have this share of such places: silhouettes and edges that are a pixel off.
MOST_SHINING = 0.08
#: From less than this share of the object, or fewer places, nothing is concluded.
LEAST_COVERED, LEAST_PLACES = 0.5, 200
#: A place counts when at least this many photos show it.
LEAST_PHOTOS = 4
#: Coded value up to which a photo is too dark to compare.
DARKEST = 12
#: Blur (pixels) before photos are compared: poses are about that exact.
BLUR = 1.0
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
_ROUNDS = 10


@dataclass(frozen=True)
class Changes:
    """How brightness changes over the photos: `places` compared, `photos` that show one (median), `typical` brightening of a place
    (median, relative), `shining` share of places that brighten by more than CHANGE."""

    places: int
    photos: float
    typical: float
    shining: float


class Sightings:
    """What the photos show at places of the surface `points` (k, 3); add the photos one by one."""

    def __init__(self, points: Array) -> None:
        self.points = points
        self._rows: list[NDArray[np.float64]] = []

    def add(self, camera: Camera, rgb: NDArray[np.uint8], seen: NDArray[np.bool_]) -> None:
        """One photo (h, w, 3) sRGB of `camera`, which sees the places `seen` (k,); places at its border are passed over."""
        row = np.full(len(self.points), np.nan)
        pixel, _ = camera.project(self.points)
        index = np.flatnonzero(seen & (pixel > 1).all(1) & (pixel[:, 0] < camera.width - 1) & (pixel[:, 1] < camera.height - 1))
        if len(index):
            value = luminance_at(decode_bytes(rgb), pixel[index], BLUR)
            strongest = cv2.GaussianBlur(rgb.max(2), (0, 0), BLUR)
            code = read_at(strongest, *(pixel[index].T - 0.5))
            good = (code > DARKEST) & (value > 0)
            row[index[good]] = np.log(value[good])
        self._rows.append(row)

    def changes(self) -> Changes:
        """Compare the photos added so far; nothing to compare gives no places."""
        table = np.stack(self._rows) if self._rows else np.zeros((0, len(self.points)))
        table = table[:, np.isfinite(table).sum(0) >= LEAST_PHOTOS]
        if table.shape[1] == 0:
            return Changes(0, 0.0, math.nan, math.nan)
        left = table - exposures(table)[:, None]
        rise = np.expm1(np.nanquantile(left, BRIGHT_PHOTOS, axis=0) - np.nanmedian(left, 0))
        photos = float(np.median(np.isfinite(table).sum(0)))
        return Changes(table.shape[1], photos, float(np.median(rise)), float((rise > CHANGE).mean()))


def luminance_at(linear: NDArray[np.float32], pixel: Array, blur: float) -> NDArray[np.float64]:
    """Luminance (n,) of a linear picture (h, w, 3), blurred by `blur` pixels, at the pixel positions (n, 2)."""
    smooth = cv2.GaussianBlur(linear @ _LUMINANCE, (0, 0), blur)
    return read_at(smooth, *(pixel.T - 0.5)).astype(np.float64)


def exposures(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """One offset per photo (n,) of log brightness (n, k; not a number where unseen), by alternating medians; their median is 0."""
    offset = np.zeros(len(table))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a photo that shows no place has no median
        for _ in range(_ROUNDS):
            place = np.nanmedian(table - offset[:, None], 0)
            offset = np.nan_to_num(np.nanmedian(table - place, 1))
            offset -= np.median(offset)
    return offset


def looks_diffuse(changes: Changes, covered: float) -> tuple[bool, str]:
    """Whether the object looks the same from everywhere, and the evidence; `covered` is the share of it that was compared."""
    if changes.places < LEAST_PLACES:
        return False, f"only {changes.places} places could be compared"
    evidence = (
        f"{100 * changes.shining:.1f} % of {changes.places} places shine by more than {100 * CHANGE:.0f} % in some of about "
        f"{changes.photos:.0f} photos, typically by {100 * changes.typical:.1f} %; {100 * covered:.0f} % of the object is compared"
    )
    return changes.shining <= MOST_SHINING and covered >= LEAST_COVERED, evidence
