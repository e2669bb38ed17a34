"""Depth maps for fusion: stereo depths replace rendered ones where both agree.

A rendered depth is accurate to about a cell everywhere, a stereo depth to a fraction of a pixel on textured surfaces. Where they differ by
more than a few cells one of them is wrong, and the rendered depth, fitted to every photo, is kept.

Rendered depths have a systematic error (on avocado they lie .45 pixels behind stereo depths), so a photo's rendered depths are scaled by
the median ratio of the two where they agree.
On avocado that takes chamfer from .0418 to .0388 % and normals from 4.09 to 3.95°, on boombox from .0907 to .0901 % and 6.55 to 6.50°.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.meshing.depth_views import DepthView

Floats = NDArray[np.float32]

#: Minimum confidence of a stereo depth.
MIN_CONFIDENCE = 0.2
#: Minimum number of pixels with both depths for scaling the rendered ones.
MIN_OVERLAP = 500
#: Weight of a stereo depth of confidence 1 relative to a rendered one.
MAX_WEIGHT_RATIO = 4.0


def resample_depth(depth: Floats, confidence: Floats, width: int, height: int, max_step: float) -> tuple[Floats, Floats]:
    """Inverse depth (height, width) and confidence of a z-depth map (h, w; 0 = none) resampled to another size of the same photo.

    Inverse depths, linear on planes, are bilinear where the neighbours exist and differ by less than the fraction `max_step`, else
    nearest-neighbour.
    """
    rows, columns = depth.shape
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
    x = np.broadcast_to(((np.arange(width) + 0.5) * columns / width - 0.5).astype(np.float32)[None, :], (height, width))
    y = np.broadcast_to(((np.arange(height) + 0.5) * rows / height - 0.5).astype(np.float32)[:, None], (height, width))
    x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)
    interpolated = cv2.remap(inverse, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    nearest = cv2.remap(inverse, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    resampled_confidence = cv2.remap(np.ascontiguousarray(confidence, np.float32), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    box = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(inverse, box), cv2.dilate(inverse, box)
    continuous = cv2.remap((high < low * (1 + max_step)).astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0
    return np.where(continuous, interpolated, nearest).astype(np.float32), np.where(nearest > 0, resampled_confidence, 0).astype(np.float32)


def merge_stereo_depth(view: DepthView, depth: Floats, confidence: Floats, tolerance: float) -> tuple[DepthView, float]:
    """Replace depths of `view` by stereo z-depths (h, w, any size of the photo; 0 = none) that agree to `tolerance` (world units).

    The other depths are scaled by the median ratio. Also returns the share of the pixels with depth that were replaced.
    """
    camera = view.camera
    inverse, resampled_confidence = resample_depth(depth, confidence, camera.width, camera.height, 0.02)
    in_both = (view.inverse > 0) & (inverse > 0) & (resampled_confidence >= MIN_CONFIDENCE) & (view.mask_distance == 0)
    z, rendered = 1 / np.where(in_both, inverse, 1), 1 / np.where(in_both, view.inverse, 1)
    replaced = in_both & (np.abs(z - rendered) < tolerance)
    valid_count = int((view.inverse > 0).sum())
    ratio = np.median(rendered[replaced] / z[replaced]) if replaced.sum() >= MIN_OVERLAP else 1.0
    out = replace(
        view,
        inverse=np.where(replaced, inverse, view.inverse * ratio).astype(np.float32),
        weight=np.where(replaced, view.weight * (1 + (MAX_WEIGHT_RATIO - 1) * resampled_confidence), view.weight).astype(np.float32),
    )
    return out, float(replaced.sum()) / max(valid_count, 1)
