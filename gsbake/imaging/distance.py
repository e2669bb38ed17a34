"""Euclidean distances in binary images.

OpenCV's precise transform (Felzenszwalb & Huttenlocher, *Distance transforms of sampled functions*, Theory of Computing 2012) returns
square roots whose last bit depends on where in memory the result lies, so the same mask gives different bits from run to run. The squares
are whole numbers: rounding to them and taking the root again makes the result reproducible.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def distance_to_zero(image: NDArray[Any]) -> NDArray[np.float32]:
    """Distance (h, w) in pixels from each pixel's centre to the nearest zero pixel's of `image` (h, w); the same bits in every run.

    Correct to float32 rounding for distances up to 2 000 pixels; an image without a zero pixel has no meaningful distances.
    """
    far = cv2.distanceTransform(np.ascontiguousarray(image != 0, np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.sqrt(np.rint(far * far)).astype(np.float32)
