"""Completion of masks that miss a part of the object, detected by the tie points of the other photos.

One mask that misses the dark mouth of a mug marks everything behind it as empty, and a visual hull tolerates only few wrong views. A point
of the object projects into every mask, occluded or not. So points that nearly all masks include and one mask excludes, many of them in
one region, are errors of that mask. The missing region is taken from the visual hull of the correct masks.
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

#: Distance outside the mask, as a share of the longer side, from which a point is excluded.
OUTSIDE_MARGIN = 0.01
#: A point belongs to the object when at least this many photos show it and at most this share of them (but one in any case) exclude it.
MIN_VIEWS, MAX_EXCLUDED_SHARE = 5, 0.03
#: A mask is wrong where it excludes at least this many points in one region, and this share of all points.
MIN_EXCLUDED_POINTS, MIN_EXCLUDED_SHARE = 10, 0.01
#: With a larger share of wrong masks it is ambiguous which masks are correct.
MAX_WRONG_SHARE = 0.2
#: Points tested; more do not change the result.
MAX_POINTS = 50_000
#: Cells along the cube of half edge 1 in the hull of the correct masks.
HULL_CELLS = 96


@dataclass(frozen=True)
class MaskCompletion:
    """A wrong mask: the photo's `index`, the number of object `points` it excludes, and the `missing` region (h, w)."""

    index: int
    points: int
    missing: NDArray[np.bool_]


def excluded_points(cameras: Sequence[Camera], masks: Sequence[Bytes], points: Array) -> list[Array]:
    """For each photo the pixels (k, 2) at which points of the object lie outside its mask; `points` (n, 3) may include background."""
    views, excluded = np.zeros(len(points), np.int64), np.zeros((len(cameras), len(points)), bool)
    pixels = []
    for index, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        pixel, z = camera.project(points)
        visible = camera.in_view(pixel, z)
        column, row = np.floor(pixel[visible]).astype(np.int64).T
        excluded[index, visible] = silhouette_distance(mask)[row, column] > OUTSIDE_MARGIN * max(mask.shape)
        views += visible
        pixels.append(pixel)
    on_object = (views >= MIN_VIEWS) & (excluded.sum(0) <= np.maximum(MAX_EXCLUDED_SHARE * views, 1))
    min_count = max(MIN_EXCLUDED_POINTS, MIN_EXCLUDED_SHARE * on_object.sum())
    found = [pixel[outside & on_object] for pixel, outside in zip(pixels, excluded, strict=True)]
    return [f if len(f) >= min_count else f[:0] for f in found]


def render_silhouette(hull: Hull, camera: Camera) -> NDArray[np.bool_]:
    """Pixels (h, w) of the camera that the hull covers, accurate to about a cell."""
    return render_cells(hull.centres(), hull.cell, camera)


def render_cells(centres: Array, cell: float, camera: Camera, closing: float = 0.6) -> NDArray[np.bool_]:
    """Pixels (h, w) of the camera that cells of edge `cell` around `centres` (n, 3) cover, accurate to about a cell.

    Gaps between them are closed by a disc whose radius is `closing` cells.
    """
    pixel, z = camera.project(centres)
    visible = camera.in_view(pixel, z)
    image = np.zeros((camera.height, camera.width), np.uint8)
    column, row = np.floor(pixel[visible]).astype(np.int64).T
    image[row, column] = 1
    radius = max(1, round(closing * cell * camera.fx / float(np.median(z[visible])))) if visible.any() else 1
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_CLOSE, disc(radius)) > 0)


def complete_masks(cameras: Sequence[Camera], masks: Sequence[Bytes], points: Array) -> list[MaskCompletion]:
    """Masks (h, w) that miss a part of the object, with the missing region; `cameras` are pinholes of their sizes in the unit frame.

    `points` (n, 3) are tie points of the object and of the background. Empty when no mask is wrong, or too many are.
    """
    pixels = excluded_points(cameras, masks, points[:: -(-len(points) // MAX_POINTS) or 1])
    wrong = [i for i, p in enumerate(pixels) if len(p)]
    correct = [i for i, p in enumerate(pixels) if not len(p)]
    if not wrong or len(wrong) > MAX_WRONG_SHARE * len(cameras):
        return []
    hull = Hull.from_masks([cameras[i] for i in correct], [masks[i] for i in correct], np.zeros(3), 1.0, HULL_CELLS)
    if hull.empty:
        return []
    completions = []
    for index in wrong:
        mask = masks[index]
        missing = render_silhouette(hull, cameras[index]) & (mask <= 127)
        # The hull is slightly larger than the object all around: opening removes this boundary.
        boundary = disc(max(1, round(OUTSIDE_MARGIN * max(mask.shape))))
        regions = cv2.morphologyEx(missing.astype(np.uint8), cv2.MORPH_OPEN, boundary)
        _, label = cv2.connectedComponents(regions)
        column, row = np.floor(pixels[index]).astype(np.int64).T
        count = np.bincount(label[row, column], minlength=int(label.max()) + 1)
        count[0] = 0
        confirmed = count >= MIN_EXCLUDED_POINTS
        if confirmed.any():
            completions.append(MaskCompletion(index, int(count[confirmed].sum()), confirmed[label]))
    return completions


def disc(radius: int) -> Bytes:
    """Structuring element of a disc of this radius in pixels."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
