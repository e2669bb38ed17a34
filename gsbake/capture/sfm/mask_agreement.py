"""Agreement of solved cameras with the masks: how well the visual hull of all masks covers each one.

Structure from motion that places every photo may still be wrong: a background that did not move with the object ties photos together. Masks
tell, because silhouettes of one rigid object have a common hull only under its true cameras (Laurentini, *The visual hull concept*, PAMI
1994). The measure is the intersection over union of each mask and the hull's projection; the hull lies inside nearly all masks, so that it
is about the share of the mask that the others support. Guessed masks tell too, because their errors are not those of one rigid object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.masks.completion import render_silhouette
from gsbake.capture.masks.consensus import CELLS, find_consensus, intersection_over_union, small_views
from gsbake.capture.poses.normalisation import bounding_sphere_from_masks
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

#: Agreement below which cameras and masks contradict each other, of the user's masks and of guessed ones.
MIN_AGREEMENT, MIN_GUESS_AGREEMENT = 0.85, 0.8


def mask_agreement(cameras: Sequence[Camera], masks: Mapping[str, Path]) -> float:
    """Median over the `cameras` of the intersection over union (0 … 1) of mask and projected hull; `masks` are files by photo name.

    0 where the masks have no common object or the distortion cannot be inverted.
    """
    try:
        pinholes, images = small_views(cameras, masks)
    except BadInputError:
        return 0.0
    sphere = bounding_sphere_from_masks(pinholes, images)
    if sphere is None:
        return 0.0
    hull = Hull.from_masks(pinholes, images, sphere.centre, sphere.radius, CELLS)
    overlap = [intersection_over_union(m > 127, render_silhouette(hull, c)) for c, m in zip(pinholes, images, strict=True)]
    return float(np.median(overlap))


def guess_agreement(cameras: Sequence[Camera], guesses: Mapping[str, Path]) -> float:
    """As `mask_agreement`, for guessed masks, of which many may be wrong."""
    found = find_consensus(cameras, guesses)
    return 0.0 if found is None else found.agreement
