"""What a photo is worth: blur, exposure, and whether another photo already shows the same.

Blur follows Crété, Dolmiere, Ladret, Nicolas, *The blur effect* (SPIE 2007): how little a photo changes when it is blurred again.
Unlike the variance of the Laplacian it does not call smooth objects blurred.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.decode import Bytes
from gsbake.capture.photos.sharpness import loss_at_half
from gsbake.imaging.srgb import decode_bytes

#: Thumbnails (32x32 grey) whose root mean square difference is below this (of 255) show the same picture.
SAME_PICTURE = 1.0
_THUMB = 32
_RE_BLUR = 9
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class Quality:
    """Figures of one photo: `blur` 0 (sharp) .. 1, `exposure` mean log2 of linear luminance, `loss_at_half` (grey levels, see
    `gsbake.capture.photos.sharpness`), `thumbnail` (32, 32) grey levels."""

    blur: float
    exposure: float
    loss_at_half: float
    thumbnail: NDArray[np.float32]


def blur_effect(grey: NDArray[np.float32], mask: Bytes | None = None) -> float:
    """Blur of a grey photo (h, w), 0 sharp to 1 blurred, measured where `mask` (255 = count) says so; the worse of both directions."""
    inside = None if mask is None else mask > 127
    worst = 0.0
    for axis, kernel in ((1, (_RE_BLUR, 1)), (0, (1, _RE_BLUR))):
        again = cv2.blur(grey, kernel)
        before = np.abs(np.diff(grey, axis=axis))
        lost = np.maximum(before - np.abs(np.diff(again, axis=axis)), 0.0)
        if inside is not None:
            both = np.logical_and(*((inside[:, 1:], inside[:, :-1]) if axis == 1 else (inside[1:], inside[:-1])))
            before, lost = before[both], lost[both]
        total = float(before.sum(dtype=np.float64))
        if total > 0:
            worst = max(worst, 1.0 - float(lost.sum(dtype=np.float64)) / total)
    return worst


def measure(rgb: Bytes, mask: Bytes | None) -> Quality:
    """Figures of a working photo (h, w, 3) sRGB, taken inside its mask when it has one that is not empty."""
    inside = mask if mask is not None and (mask > 127).any() else None
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(rgb, (256, 256), interpolation=cv2.INTER_AREA)
    luminance = decode_bytes(np.asarray(small, np.uint8)) @ _LUMINANCE
    stops = np.log2(np.maximum(luminance, 1e-4))
    if inside is not None:
        share = cv2.resize(inside, (256, 256), interpolation=cv2.INTER_AREA) > 127
        stops = stops[share] if share.any() else stops
    thumbnail = cv2.resize(grey, (_THUMB, _THUMB), interpolation=cv2.INTER_AREA).astype(np.float32)
    fine = grey.astype(np.float32)
    return Quality(blur_effect(fine, inside), float(stops.mean(dtype=np.float64)), loss_at_half(fine, inside), thumbnail)


def near_duplicates(thumbnails: list[NDArray[np.float32]]) -> list[int | None]:
    """For each thumbnail the first earlier one that shows the same picture, or None.

    Stricter than the usual perceptual hashes: neighbouring views of a turntable must not count as duplicates, a file saved twice must.
    """
    first: list[int | None] = [None] * len(thumbnails)
    if len(thumbnails) < 2:
        return first
    flat = np.stack([t.ravel() for t in thumbnails]).astype(np.float64)
    square = (flat**2).sum(1)
    for i in range(1, len(flat)):
        distance = np.maximum(square[:i] + square[i] - 2 * (flat[:i] @ flat[i]), 0.0) / flat.shape[1]
        hits = np.flatnonzero(distance < SAME_PICTURE**2)
        if hits.size:
            earlier = int(hits[0])
            first[i] = earlier if first[earlier] is None else first[earlier]
    return first


def blurred(figures: list[float]) -> list[int]:
    """Indices of photos much more blurred than the rest: above the median by 4 robust standard deviations and by 0.1."""
    if len(figures) < 5:
        return []
    values = np.asarray(figures)
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return [int(i) for i in np.flatnonzero(values > middle + max(4 * spread, 0.1))]
