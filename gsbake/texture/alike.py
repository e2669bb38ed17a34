"""Averages over neighbouring texels that look alike: a filter that stops at the edges of what the photos show.

The domain transform of a slightly blurred image of the object: paths through it get longer where the colour changes, and a box filter run
along rows and columns of that longer texture does not cross an edge. Charts end where the texture has nothing.

Gastal & Oliveira, *Domain transform for edge-aware image and video processing*, SIGGRAPH 2011 (OpenCV's `ximgproc`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.texture.colour import encode
from gsbake.texture.texels import Texels

#: Texels along a surface of one colour, and sRGB difference, over which neighbours count.
REACH, DIFFERENT = 30.0, 0.3
#: The colours compared are averages over about this many texels: a fine pattern is one thing.
PATTERN = 2.0
#: Colour of the texture outside the charts: far from every other.
NOTHING = -1.0


class Alike:
    """The filter of `texels` whose linear colours (n, 3) are `shown`."""

    def __init__(self, texels: Texels, shown: NDArray[Any]) -> None:
        self._texels = texels
        covered = texels.covered()
        colour = cv2.GaussianBlur(texels.image(encode(np.clip(np.asarray(shown, np.float32), 0, 1))), (0, 0), PATTERN)
        share = np.maximum(cv2.GaussianBlur(covered.astype(np.float32), (0, 0), PATTERN), 1e-3)
        colour = np.where(covered, colour.transpose(2, 0, 1) / share, NOTHING).transpose(1, 2, 0).astype(np.float32, order="C")
        self._filter = cv2.ximgproc.createDTFilter(colour, REACH, DIFFERENT, cv2.ximgproc.DTF_NC)

    def __call__(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """`values` (n,) averaged over the texels around each that look alike."""
        image = self._filter.filter(self._texels.image(values)[..., 0])
        return np.asarray(image.ravel()[self._texels.index], np.float64)
