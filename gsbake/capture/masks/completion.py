"""Masks that leave out a part of the object, found out by the points of the other photos.

One mask that misses the dark mouth of a mug declares everything behind it empty, and a visual hull lets only few views be wrong. But a
point of the object lies inside every mask, hidden or not; so points that nearly all masks hold and one leaves out, many at one
place, are its mistake. That place is taken from the hull of the photos without mistakes: what all of them hold to be the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull, silhouette_distance
from gsbake.capture.photos.decode import Bytes
from gsbake.geometry.cameras import Array, Camera

#: A point is left out when it lies this share of the longer side outside.
OUTSIDE = 0.01
#: A point is the object's when so many photos show its place, and at most this share of them (but one in any case) leave it out.
LEAST_PHOTOS, LEFT_OUT = 5, 0.03
#: A mask is wrong where at least so many points are left out at one place, and this share of all.
LEAST_POINTS, LEAST_SHARE = 10, 0.01
#: With more wrong masks than this share it is not clear which are right.
MOST_WRONG = 0.2
#: Points looked at: more say no more.
MOST_POINTS = 50_000
#: Cells along the cube of half edge 1 in the hull of the right masks.
CELLS = 96


@dataclass(frozen=True)
class Mended:
    """One wrong mask: the photo's index, how many points of the object it left out, and the part (h, w) that it lacks."""

    index: int
    points: int
    missing: NDArray[np.bool_]


def left_out(cameras: Sequence[Camera], masks: Sequence[Bytes], points: Array) -> list[Array]:
    """For each photo the pixels (k, 2) at which points of the object lie outside its mask. `points` (n, 3) may hold others too."""
    seen, out = np.zeros(len(points), np.int64), np.zeros((len(cameras), len(points)), bool)
    pixels = []
    for index, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        pixel, z = camera.project(points)
        shown = camera.shows(pixel, z)
        column, row = np.floor(pixel[shown]).astype(np.int64).T
        out[index, shown] = silhouette_distance(mask)[row, column] > OUTSIDE * max(mask.shape)
        seen += shown
        pixels.append(pixel)
    object_ = (seen >= LEAST_PHOTOS) & (out.sum(0) <= np.maximum(LEFT_OUT * seen, 1))
    least = max(LEAST_POINTS, LEAST_SHARE * object_.sum())
    found = [pixel[missed & object_] for pixel, missed in zip(pixels, out, strict=True)]
    return [f if len(f) >= least else f[:0] for f in found]


def silhouette(hull: Hull, camera: Camera) -> NDArray[np.bool_]:
    """Pixels (h, w) of the camera that show the hull, to about a cell."""
    centres = hull.lower + (np.argwhere(hull.occupancy) + 0.5) * hull.cell
    pixel, z = camera.project(centres)
    shown = camera.shows(pixel, z)
    image = np.zeros((camera.height, camera.width), np.uint8)
    column, row = np.floor(pixel[shown]).astype(np.int64).T
    image[row, column] = 1
    reach = max(1, round(0.6 * hull.cell * camera.fx / float(np.median(z[shown])))) if shown.any() else 1
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_CLOSE, _disc(reach)) > 0)


def mend(cameras: Sequence[Camera], masks: Sequence[Bytes], points: Array) -> list[Mended]:
    """Which masks (h, w) leave out a part of the object, and which part; `cameras` are pinholes of their sizes in the unit frame.

    `points` (n, 3) are tie points, of the object and of what is around it. Empty where no mask is wrong, or too many are.
    """
    pixels = left_out(cameras, masks, points[:: -(-len(points) // MOST_POINTS) or 1])
    wrong = [i for i, p in enumerate(pixels) if len(p)]
    right = [i for i, p in enumerate(pixels) if not len(p)]
    if not wrong or len(wrong) > MOST_WRONG * len(cameras):
        return []
    hull = Hull.of([cameras[i] for i in right], [masks[i] for i in right], np.zeros(3), 1.0, CELLS)
    if hull.empty:
        return []
    mended = []
    for index in wrong:
        mask = masks[index]
        missing = silhouette(hull, cameras[index]) & (mask <= 127)
        # The hull is a little wider than the object all around: that rim is no mistake.
        rim = _disc(max(1, round(OUTSIDE * max(mask.shape))))
        core = cv2.morphologyEx(missing.astype(np.uint8), cv2.MORPH_OPEN, rim)
        _, label = cv2.connectedComponents(core)
        column, row = np.floor(pixels[index]).astype(np.int64).T
        at = np.bincount(label[row, column], minlength=int(label.max()) + 1)
        at[0] = 0
        hit = at >= LEAST_POINTS
        if hit.any():
            mended.append(Mended(index, int(at[hit].sum()), hit[label]))
    return mended


def _disc(radius: int) -> Bytes:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
