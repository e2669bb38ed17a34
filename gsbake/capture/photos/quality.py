"""Quality measures of a photo: blur, exposure, effective resolution and near-duplicates.

Blur follows Crété, Dolmiere, Ladret, Nicolas, *The blur effect* (SPIE 2007): how little a photo changes when it is blurred again.
Unlike the variance of the Laplacian this does not rate smooth objects as blurred.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.decode import Bytes
from gsbake.capture.photos.sharpness import halving_loss
from gsbake.imaging.srgb import LUMINANCE, decode_bytes

#: Root mean square difference of thumbnails (32x32 grey levels of 255) below which photos are near-duplicates.
DUPLICATE_RMS = 1.0
_THUMBNAIL_SIZE = 32
_BLUR_LENGTH = 9


@dataclass(frozen=True)
class Quality:
    """Quality of one photo: `blur` 0 (sharp) .. 1, `exposure` mean log2 of linear luminance, `halving_loss` (grey levels, see
    `gsbake.capture.photos.sharpness`), `thumbnail` (32, 32) grey levels."""

    blur: float
    exposure: float
    halving_loss: float
    thumbnail: NDArray[np.float32]


def blur_effect(grey: NDArray[np.float32], mask: Bytes | None = None) -> float:
    """Blur of a grey photo (h, w), 0 sharp to 1 blurred, inside `mask` (255 = inside); the worse of both directions."""
    inside = None if mask is None else mask > 127
    worst = 0.0
    for axis, kernel in ((1, (_BLUR_LENGTH, 1)), (0, (1, _BLUR_LENGTH))):
        smooth = cv2.blur(grey, kernel)
        variation = np.abs(np.diff(grey, axis=axis))
        lost = np.maximum(variation - np.abs(np.diff(smooth, axis=axis)), 0.0)
        if inside is not None:
            both = np.logical_and(*((inside[:, 1:], inside[:, :-1]) if axis == 1 else (inside[1:], inside[:-1])))
            variation, lost = variation[both], lost[both]
        total = float(variation.sum(dtype=np.float64))
        if total > 0:
            worst = max(worst, 1.0 - float(lost.sum(dtype=np.float64)) / total)
    return worst


def measure_quality(rgb: Bytes, mask: Bytes | None) -> Quality:
    """Quality of a working photo (h, w, 3) sRGB, measured inside its mask when it has one that is not empty."""
    inside = mask if mask is not None and (mask > 127).any() else None
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(rgb, (256, 256), interpolation=cv2.INTER_AREA)
    luminance = decode_bytes(np.asarray(small, np.uint8)) @ LUMINANCE
    stops = np.log2(np.maximum(luminance, 1e-4))
    if inside is not None:
        share = cv2.resize(inside, (256, 256), interpolation=cv2.INTER_AREA) > 127
        stops = stops[share] if share.any() else stops
    thumbnail = cv2.resize(grey, (_THUMBNAIL_SIZE, _THUMBNAIL_SIZE), interpolation=cv2.INTER_AREA).astype(np.float32)
    levels = grey.astype(np.float32)
    return Quality(blur_effect(levels, inside), float(stops.mean(dtype=np.float64)), halving_loss(levels, inside), thumbnail)


def find_near_duplicates(thumbnails: list[NDArray[np.float32]]) -> list[int | None]:
    """For each thumbnail the index of the first earlier near-duplicate, or None.

    Stricter than perceptual hashes: a photo saved twice is a duplicate, neighbouring views of a turntable are not.
    """
    first: list[int | None] = [None] * len(thumbnails)
    if len(thumbnails) < 2:
        return first
    flat = np.stack([t.ravel() for t in thumbnails]).astype(np.float64)
    square = (flat**2).sum(1)
    for i in range(1, len(flat)):
        distance = np.maximum(square[:i] + square[i] - 2 * (flat[:i] @ flat[i]), 0.0) / flat.shape[1]
        hits = np.flatnonzero(distance < DUPLICATE_RMS**2)
        if hits.size:
            earlier = int(hits[0])
            first[i] = earlier if first[earlier] is None else first[earlier]
    return first


def find_blurred(blur: list[float]) -> list[int]:
    """Indices of photos whose blur exceeds the median by 4 robust standard deviations and by 0.1."""
    if len(blur) < 5:
        return []
    values = np.asarray(blur)
    median = float(np.median(values))
    deviation = 1.4826 * float(np.median(np.abs(values - median)))
    return [int(i) for i in np.flatnonzero(values > median + max(4 * deviation, 0.1))]
