"""Guessed masks corrected by the visual hull of all of them.

A guess that agrees with the other photos almost everywhere can still lack a piece of the object or have a piece of the table. Free space
is what a single mask excludes, so that one missing piece cuts a tunnel through the object. The visual hull (Laurentini, *The visual hull
concept*, PAMI 1994) lets a few photos be wrong at each point. A pixel whose ray goes well into that hull shows the object: nearly all other
photos say so. A pixel whose ray passes at a distance even the hull that lets more photos be wrong does not: many photos exclude everything
on its ray. Between these the guess stays, which is finer than a cell of the hull.

Few photos may also be right against all others: they alone look through a hole or past the lowest part. There they show the background's
colours, so that regions with these stay empty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.ray_distance import ray_distance
from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.masks.completion import disc
from gsbake.capture.masks.consensus import MAX_OUTVOTED_SHARE, distorted, small_views
from gsbake.capture.masks.saliency import INPUT_SIZE
from gsbake.capture.photos.decode import Bytes
from gsbake.capture.poses.normalisation import bounding_sphere_from_masks
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

#: Longer side in pixels of the masks that are carved from, and cells along an edge of the hull's grid.
SIZE, CELLS = 512, 128
#: A guess stays where the ray passes less than this many pixels of the network's input, or this many cells, inside or outside the surface.
MIN_PIXELS, MIN_CELLS = 1.0, 0.5
#: A piece is background where its colours are, in the geometric mean, this many times (natural logarithm) likelier around the object than
#: on it; around is up to this share of the root of the mask's area from it; bins of the histograms along each axis of CIELAB.
MAX_LOG_RATIO, SURROUNDINGS, BINS = 2.0, 0.15, 24


def correct_by_hull(cameras: Sequence[Camera], masks: Mapping[str, Path]) -> dict[str, tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """By photo name where nearly all others see the object, and where the photo may show it (h, w): with the lens's distortion, at SIZE.

    `masks` are files by photo name, 255 = object, of any size with the photo's aspect ratio. Empty where the masks have no common object or
    the distortion cannot be inverted.
    """
    try:
        pinholes, views = small_views(cameras, masks, SIZE)
    except BadInputError:
        return {}
    sphere = bounding_sphere_from_masks(pinholes, views, MAX_OUTVOTED_SHARE)
    if sphere is None:
        return {}
    small = Hull.from_masks(pinholes, views, sphere.centre, 1.05 * sphere.radius, CELLS)
    # What few photos have in their frames is no surplus.
    large = Hull.from_masks(pinholes, views, sphere.centre, 1.05 * sphere.radius, CELLS, MAX_OUTVOTED_SHARE, min_visible_share=0.0)
    out = {}
    for camera, pinhole in zip(cameras, pinholes, strict=True):
        depth = max(float(np.linalg.norm(pinhole.centre - sphere.centre)), 1e-9)
        margin = max(MIN_PIXELS * max(pinhole.width, pinhole.height) / INPUT_SIZE, MIN_CELLS * small.cell * pinhole.fx / depth)
        certain, possible = ray_distance(small, pinhole, margin) < -margin, ray_distance(large, pinhole, margin) < margin
        out[camera.name] = distorted(certain, camera, SIZE), distorted(possible, camera, SIZE)
    return out


def apply_correction(mask: Bytes, photo: Callable[[], Bytes], certain: NDArray[np.bool_], possible: NDArray[np.bool_]) -> Bytes:
    """The `mask` (h, w) filled where it lacks what is `certain`, unless in the background's colours, without what is not `possible`.

    `photo` reads the photo (h, w, 3), 8-bit sRGB of any size; only masks that lack something need it. `certain` and `possible` (h', w') are
    those of `correct_by_hull`.
    """
    size = certain.shape[::-1]
    inside = (cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127) & possible
    filled = certain & ~inside
    if filled.any():
        small = np.asarray(cv2.resize(photo(), size, interpolation=cv2.INTER_AREA), np.uint8)
        filled = _without_background(small, inside, filled)
    full = mask.shape[::-1]
    inner, outer = (cv2.resize(255 * part.astype(np.uint8), full, interpolation=cv2.INTER_LINEAR) for part in (filled, possible))
    return np.where(inner > 127, 255, np.where(outer > 127, mask, 0)).astype(np.uint8)


def _without_background(photo: Bytes, inside: NDArray[np.bool_], pieces: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those of the `pieces` (h, w) whose colours in the `photo` are not much likelier around the object than `inside` it."""
    radius = max(1, round(SURROUNDINGS * float(np.sqrt(np.count_nonzero(inside)))))
    around = cv2.dilate(inside.astype(np.uint8), disc(radius)) > 0
    lab = np.asarray(cv2.cvtColor(photo, cv2.COLOR_RGB2LAB), np.uint8)
    object_colours, background_colours = (_histogram(lab, part) for part in (inside, around & ~inside & ~pieces))
    ratio = np.log(background_colours / object_colours)[tuple((lab[pieces].astype(np.int64) * BINS // 256).T)]
    count, region = cv2.connectedComponents(pieces.astype(np.uint8))
    label = region[pieces]
    evidence = np.bincount(label, ratio, count) / np.maximum(np.bincount(label, minlength=count), 1)
    object_like = evidence < MAX_LOG_RATIO
    object_like[0] = False
    return np.asarray(object_like[region])


def _histogram(lab: NDArray[np.uint8], part: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Smoothed distribution (BINS, BINS, BINS) of the colours of a `part` (h, w) of an image (h, w, 3)."""
    from scipy.ndimage import gaussian_filter

    counts = np.zeros((BINS, BINS, BINS))
    np.add.at(counts, tuple((lab[part].astype(np.int64) * BINS // 256).T), 1.0)
    smooth = gaussian_filter(counts, 1.0, mode="nearest") + 1e-3
    return np.asarray(smooth / smooth.sum())
