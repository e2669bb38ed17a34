"""Detection of a static background: the object turned in front of a fixed camera, so background features contradict the object's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

#: Standard deviation of background pixels over all photos, in grey levels, below which the background is static (noise and flicker pass).
MAX_STATIC_DEVIATION = 8.0
_SIZE = 96


def is_background_static(files: Sequence[tuple[Path, Path]]) -> tuple[bool, str]:
    """Whether the background outside the masks is the same in all photos, and the evidence.

    `files` are (photo, mask). Photos of different sizes are not from a fixed camera.
    """
    greys, outside = [], []
    shapes = set()
    for photo, mask in files:
        grey: Any = cv2.imread(str(photo), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        inside: Any = cv2.imread(str(mask), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        shapes.add(grey.shape)
        greys.append(cv2.resize(grey, (_SIZE, _SIZE), interpolation=cv2.INTER_AREA).astype(np.float32))
        # A margin excludes shadows and soft edges of the object.
        outside.append(cv2.dilate(cv2.resize(inside, (_SIZE, _SIZE), interpolation=cv2.INTER_AREA), np.ones((5, 5), np.uint8)) < 8)
    if len(shapes) > 1:
        return False, "photos of different sizes"
    stack, background = np.stack(greys), np.stack(outside)
    count = background.sum(0)
    often = count >= 0.7 * len(files)
    if often.mean() < 0.05:
        return False, "too little background visible"
    mean = (stack * background).sum(0) / np.maximum(count, 1)
    deviation = np.sqrt(((stack - mean) ** 2 * background).sum(0) / np.maximum(count, 1))[often]
    typical = float(np.quantile(deviation, 0.75))
    return typical < MAX_STATIC_DEVIATION, f"the background varies by {typical:.1f} grey levels over the photos"
