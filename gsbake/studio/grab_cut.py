"""The part of a photo that a rough stroke means: GrabCut on the surroundings of the stroke."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.masks.grab_cut import cut_by_colour
from gsbake.errors import UsageError

Bytes = NDArray[np.uint8]

#: Longer side in pixels at which GrabCut works, and how far beyond a stroke it looks: a share of the stroke's longer side, and one of the
#: picture's.
CUT_SIZE, CUT_MARGIN, CUT_ROOM = 640, 1.0, 0.12


def grab_cut(photo: Bytes, mask: Bytes, inside: NDArray[np.bool_], outside: NDArray[np.bool_]) -> Bytes:
    """The mask (h, w) of a photo (h, w, 3, BGR) with strokes (h, w) `inside` and `outside` the object, around which GrabCut (Rother et al.,
    SIGGRAPH 2004) finds the border. Raises UsageError without a stroke."""
    rows, columns = np.nonzero(inside | outside)
    if not len(rows):
        raise UsageError("There is no stroke; draw one over the part that the mask lacks, or has too much.")
    margin = int(CUT_MARGIN * max(np.ptp(rows), np.ptp(columns)) + CUT_ROOM * max(mask.shape)) + 1
    box = [slice(max(int(at.min()) - margin, 0), int(at.max()) + margin) for at in (rows, columns)]
    window = tuple(box)
    height, width = mask[window].shape
    scale = min(1.0, CUT_SIZE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    labels = np.where(cv2.resize(mask[window], size, interpolation=cv2.INTER_AREA) > 127, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    for stroke, label in ((inside, cv2.GC_FGD), (outside, cv2.GC_BGD)):
        labels[cv2.resize(stroke[window].astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0] = label
    if not np.isin(labels, (cv2.GC_BGD, cv2.GC_PR_BGD)).any() or not np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).any():
        raise UsageError("The stroke covers everything around it; draw a thinner one.")
    small = cv2.resize(photo[window], size, interpolation=cv2.INTER_AREA)
    found = np.asarray(np.where(cut_by_colour(small, labels), 255, 0), np.uint8)
    out = mask.copy()
    out[window] = np.where(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR) > 127, 255, 0)
    out[inside], out[outside] = 255, 0
    return out
