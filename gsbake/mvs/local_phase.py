"""Photos as local phase, for a second matching where a highlight changes brightness and contrast but not edges.

The phase of the local signal does not depend on its brightness or contrast (Fleet & Jepson, *Computation of component image velocity
from local phase information*, IJCV 1990). Here it is the even part, the Laplacian, as a share of the even and the odd part, the length of
the gradient (compare Felsberg & Sommer, *The monogenic signal*, IEEE Transactions on Signal Processing 2001). Where photos confirm little
by their brightness, what they confirm by this gives surfels more points to start on.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from gsbake.mvs.depth_maps import DepthMap
from gsbake.mvs.pyramids import Photo

#: Standard deviation of the blur in pixels; grey levels of the greatest phase; amplitude in grey levels below which there is no phase.
BLUR, AMPLITUDE, NOISE = 1.0, 40.0, 1.5


def local_phase(photo: Photo) -> Photo:
    """The photo with its phase as grey (h, w), 128 on a straight edge, more or less beside it."""
    smooth = cv2.GaussianBlur(photo.grey.astype(np.float32), (0, 0), BLUR)
    odd = np.hypot(*(cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (0, 1)))
    even = cv2.Laplacian(smooth, cv2.CV_32F)
    phase = even / (odd + np.abs(even) + NOISE)
    return replace(photo, grey=np.asarray((128 + AMPLITUDE * phase).round(), np.uint8))


def complete(first: DepthMap, second: DepthMap) -> DepthMap:
    """The first depth map with the second's depths where it has none."""
    add = (first.confidence == 0) & (second.confidence > 0)
    return replace(
        first, plane=np.where(add[..., None], second.plane, first.plane), confidence=np.where(add, second.confidence, first.confidence),
        views=np.where(add, second.views, first.views), by_phase=add,
    )  # fmt: skip
