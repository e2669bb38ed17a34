"""Whether the object turned in front of a standing camera: then features on the background contradict those on the object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

#: Spread of a background pixel over all photos, in grey levels, below which the background stands still (noise and flicker pass).
STILL = 8.0
_SIZE = 96


def standing_background(files: Sequence[tuple[Path, Path]]) -> tuple[bool, str]:
    """Whether what lies outside the masks stays the same in all photos, and the evidence in words.

    `files` are (photo, mask). Photos of different sizes were not taken by a standing camera.
    """
    greys, outside = [], []
    shapes = set()
    for photo, mask in files:
        grey: Any = cv2.imread(str(photo), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        solid: Any = cv2.imread(str(mask), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        shapes.add(grey.shape)
        greys.append(cv2.resize(grey, (_SIZE, _SIZE), interpolation=cv2.INTER_AREA).astype(np.float32))
        # A margin keeps shadows and soft edges of the object out.
        outside.append(cv2.dilate(cv2.resize(solid, (_SIZE, _SIZE), interpolation=cv2.INTER_AREA), np.ones((5, 5), np.uint8)) < 8)
    if len(shapes) > 1:
        return False, "photos of different sizes"
    stack, free = np.stack(greys), np.stack(outside)
    count = free.sum(0)
    often = count >= 0.7 * len(files)
    if often.mean() < 0.05:
        return False, "hardly any background in view"
    mean = (stack * free).sum(0) / np.maximum(count, 1)
    spread = np.sqrt(((stack - mean) ** 2 * free).sum(0) / np.maximum(count, 1))[often]
    typical = float(np.quantile(spread, 0.75))
    return typical < STILL, f"background varies by {typical:.1f} grey levels over the photos"
