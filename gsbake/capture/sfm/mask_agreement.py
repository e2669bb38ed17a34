"""Agreement of solved cameras with the masks: how well the visual hull of all masks covers each one.

Structure from motion that places every photo may still be wrong: a background that did not move with the object ties photos together. Masks
tell, because silhouettes of one rigid object have a common hull only under its true cameras (Laurentini, *The visual hull concept*, PAMI
1994). The measure is the intersection over union of each mask and the hull's projection; the hull lies inside nearly all masks, so that it
is about the share of the mask that the others support.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.masks.completion import render_silhouette
from gsbake.capture.photos.decode import Bytes
from gsbake.capture.photos.undistortion import pinhole_camera, remap_tables, resample
from gsbake.capture.poses.normalisation import bounding_sphere_from_masks
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

#: Longer side of the compared masks in pixels, and cells along an edge of the hull's grid.
MASK_SIZE, CELLS = 256, 96


def mask_agreement(cameras: Sequence[Camera], masks: Mapping[str, Path]) -> float:
    """Median over the `cameras` of the intersection over union (0 … 1) of mask and projected hull; `masks` are files by photo name.

    0 where the masks have no common object or the distortion cannot be inverted.
    """
    try:
        views = [_pinhole_view(camera, masks[camera.name]) for camera in cameras]
    except BadInputError:
        return 0.0
    pinholes, images = [camera for camera, _ in views], [mask for _, mask in views]
    sphere = bounding_sphere_from_masks(pinholes, images)
    if sphere is None:
        return 0.0
    hull = Hull.from_masks(pinholes, images, sphere.centre, sphere.radius, CELLS)
    return float(np.median([_overlap(mask, render_silhouette(hull, camera)) for camera, mask in views]))


def _pinhole_view(camera: Camera, file: Path) -> tuple[Camera, Bytes]:
    """The reduced pinhole camera and its undistorted mask (h, w)."""
    mask: Any = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise FileNotFoundError(file)
    small = camera.downscaled_to(MASK_SIZE)
    mask = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA)
    pinhole = pinhole_camera(small)
    if any(camera.distortion):
        mask = resample(np.asarray(mask, np.uint8), remap_tables(small, pinhole), mask=True)
    return pinhole, np.asarray(mask, np.uint8)


def _overlap(mask: Bytes, shown: NDArray[np.bool_]) -> float:
    """Intersection over union of the `mask` (h, w) and the pixels that the hull covers."""
    union = np.count_nonzero((mask > 127) | shown)
    return np.count_nonzero((mask > 127) & shown) / union if union else 0.0
