"""The object's border by colour: GrabCut (Rother, Kolmogorov & Blake, SIGGRAPH 2004) around a mask that is nearly right."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

#: Iterations of GrabCut, and the longer side in pixels of the photo in which a border is looked for.
STEPS, SIZE = 4, 600
#: Half the width of the band around a mask in which its border may lie, as a share of the root of its area; room around it for the colours
#: of the background, in such widths.
BAND, ROOM = 0.07, 3
#: Range of the area of the result, in areas of the mask: outside of it colours do not distinguish the object.
AREAS = 0.7, 1.4


def cut_by_colour(photo: NDArray[Any], labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where the object is in a photo (h, w, 3) of which `labels` (h, w), OpenCV's GC_*, tell some; there must be both kinds."""
    cv2.setRNGSeed(0)
    found = labels.copy()
    cv2.grabCut(np.ascontiguousarray(photo), found, (0, 0, 0, 0), np.zeros((1, 65)), np.zeros((1, 65)), STEPS, cv2.GC_INIT_WITH_MASK)
    return np.asarray((found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD))


def border_by_colour(photo: Bytes, mask: Bytes) -> Bytes:
    """The `mask` (h, w; 255: object) of a photo (h, w, 3) with its border where the colours of inside and outside meet, within a band."""
    scale = min(1.0, SIZE / max(mask.shape))
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    small: Any = np.uint8(cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127)
    band = max(2, round(BAND * float(np.sqrt(small.sum()))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    inner, outer = cv2.erode(small, kernel) > 0, cv2.dilate(small, kernel) > 0
    if not inner.any():
        return mask
    rows, columns = np.nonzero(outer)
    window = tuple(slice(max(0, int(at.min()) - ROOM * band), int(at.max()) + ROOM * band) for at in (rows, columns))
    if outer[window].all():
        return mask
    labels = np.where(small > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[inner], labels[~outer] = cv2.GC_FGD, cv2.GC_BGD
    found = np.zeros(small.shape, np.bool_)
    found[window] = cut_by_colour(cv2.resize(photo, size, interpolation=cv2.INTER_AREA)[window], labels[window])
    if not AREAS[0] < found.sum() / small.sum() < AREAS[1]:
        return mask
    full = cv2.resize(np.where(found, np.uint8(255), np.uint8(0)), mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(full > 127, np.uint8(255), np.uint8(0))
