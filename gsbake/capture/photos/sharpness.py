"""Effective resolution of photos: a photo that survives halving and enlarging without loss is oversampled by a factor of two or more.

Photos that are out of focus, motion-blurred, denoised or enlarged hold nothing in their finest octave. The loss is measured where it is
largest: one sharp label on a smooth object is detail, however small. Noise counts as detail, so a noisy photo keeps its size.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

#: Root mean square change of a tile (grey levels of 255) that counts as lossless: about the quantisation of 8 bits.
LOSSLESS_RMS = 1.0
#: Edge of a tile in pixels, and the share of tiles that may lose more: specks and hot pixels.
TILE_SIZE, OUTLIER_SHARE = 32, 0.01
#: Width in pixels of the band around the mask that counts too: the silhouette is the sharpest edge of a smooth object.
BOUNDARY_WIDTH = 4
#: Photos are never halved below this longer side in pixels: structure from motion and silhouettes need it.
MIN_SIZE = 500


def halving_loss(grey: NDArray[np.float32], mask: NDArray[np.uint8] | None = None) -> float:
    """Loss of a grey photo (h, w; 0..255) at half its size in grey levels: the RMS change of its sharpest tiles.

    With `mask` (h, w; 255 = object) only pixels of the mask and a band around it count.
    """
    height, width = grey.shape
    half = cv2.resize(grey, (max(1, (width + 1) // 2), max(1, (height + 1) // 2)), interpolation=cv2.INTER_AREA)
    change = (cv2.resize(half, (width, height), interpolation=cv2.INTER_CUBIC) - grey) ** 2
    weight = np.ones(grey.shape, np.float32)
    if mask is not None and (mask > 127).any():
        weight = (cv2.dilate(mask, np.ones((2 * BOUNDARY_WIDTH + 1, 2 * BOUNDARY_WIDTH + 1), np.uint8)) > 127).astype(np.float32)
    tiles = max(1, round(width / TILE_SIZE)), max(1, round(height / TILE_SIZE))
    share = cv2.resize(weight, tiles, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(change * weight, tiles, interpolation=cv2.INTER_AREA)
    touched = share > 0.1
    return float(np.sqrt(np.quantile(mean[touched] / share[touched], 1 - OUTLIER_SHARE)))


def detect_oversampling(losses: Sequence[float], longer: int) -> tuple[bool, str]:
    """Whether photos whose largest has `longer` pixels at its longer side can be halved without loss, and the evidence.

    `losses` holds the `halving_loss` of each photo. A single sharp photo keeps all at their size.
    """
    lossless = sum(loss < LOSSLESS_RMS for loss in losses)
    evidence = (
        f"at half their {longer} pixels {lossless} of {len(losses)} photos lose less than {LOSSLESS_RMS:g} grey level; "
        f"the sharpest loses {max(losses):.1f}"
    )
    return longer >= 2 * MIN_SIZE and lossless == len(losses), evidence
