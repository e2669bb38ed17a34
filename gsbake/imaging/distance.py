"""Euclidean distance transform of binary images with reproducible bits.

OpenCV's precise transform (Felzenszwalb & Huttenlocher, *Distance transforms of sampled functions*, Theory of Computing 2012) returns
square roots whose last bit depends on the memory address of the result, so runs differ. The squares are integers: rounding to them and
taking the root again is reproducible.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def distance_to_zero(image: NDArray[Any]) -> NDArray[np.float32]:
    """Distance (h, w) in pixels from each pixel centre to the nearest zero pixel's centre of `image` (h, w).

    Exact to float32 rounding up to 2 000 pixels; undefined for an image without a zero pixel.
    """
    distance = cv2.distanceTransform(np.ascontiguousarray(image != 0, np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return np.sqrt(np.rint(distance * distance)).astype(np.float32)
