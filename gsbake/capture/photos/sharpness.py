"""How many pixels a photo really holds: one that is halved and enlarged again without loss was taken at half its size or less.

Out of focus, moved, denoised or enlarged photos carry nothing in their finest octave. The loss is looked for where it is largest: one
sharp label on a smooth thing is detail, however small its share of the picture. Noise counts as detail, so a noisy photo stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

#: Root mean square change (grey levels of 255) of a tile that is no loss: about what 8 bits cannot tell apart.
LOSSLESS = 1.0
#: Edge of a tile in pixels, and the share of tiles that may lose more: specks and hot pixels.
TILE, SPECKS = 32, 0.01
#: Pixels around the mask that count: the silhouette is the sharpest edge of a smooth object.
RIM = 4
#: Photos are not halved below this longer side, however blurred: structure from motion and silhouettes live on pixels too.
LEAST_SIZE = 500


def loss_at_half(grey: NDArray[np.float32], mask: NDArray[np.uint8] | None = None) -> float:
    """What a grey photo (h, w; 0..255) loses at half its size, in grey levels: the loss of its sharpest tiles.

    With `mask` (h, w; 255 = object) only tiles that touch it count, and only its pixels and a rim around them.
    """
    height, width = grey.shape
    half = cv2.resize(grey, (max(1, (width + 1) // 2), max(1, (height + 1) // 2)), interpolation=cv2.INTER_AREA)
    change = (cv2.resize(half, (width, height), interpolation=cv2.INTER_CUBIC) - grey) ** 2
    counts = np.ones(grey.shape, np.float32)
    if mask is not None and (mask > 127).any():
        counts = (cv2.dilate(mask, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)) > 127).astype(np.float32)
    tiles = max(1, round(width / TILE)), max(1, round(height / TILE))
    share = cv2.resize(counts, tiles, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(change * counts, tiles, interpolation=cv2.INTER_AREA)
    touched = share > 0.1
    return float(np.sqrt(np.quantile(mean[touched] / share[touched], 1 - SPECKS)))


def finer_than_sharp(losses: Sequence[float], longer: int) -> tuple[bool, str]:
    """Whether photos of `longer` pixels (the largest one's longer side) lose nothing at half their size, and the evidence.

    `losses` are those of `loss_at_half`, one per photo. A single sharp photo keeps them all as they are.
    """
    soft = sum(loss < LOSSLESS for loss in losses)
    evidence = (
        f"at half their {longer} pixels {soft} of {len(losses)} photos lose less than {LOSSLESS:g} grey level; "
        f"the sharpest loses {max(losses):.1f}"
    )
    return longer >= 2 * LEAST_SIZE and soft == len(losses), evidence
