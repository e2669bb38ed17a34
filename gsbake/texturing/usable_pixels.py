"""Which pixels of a photo show the object's surface: those of the mask without what looks like the background beside it, and without black
that other programs leave at the frame.

A mask that is a few pixels loose holds background at its edge, which would come into the texture where no other photo sees the surface
better. Programs that undistort photos fill what the lens did not see with black, at the same place in all photos.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos, View

Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

#: How far inside a mask background is looked for, as a share of the photo's longer side.
BAND = 0.004
#: Pixels outside the mask at which the background is taken, clear of mixed ones, and largest difference from it in 8-bit codes.
BACKGROUND_DISTANCE, SAME_COLOUR = 3.0, 6
#: Largest 8-bit code of black at the frame, the least share of the photo that it covers, and a margin: JPEG and filters blur its edge.
BLACK, MIN_BLACK_SHARE, BLACK_MARGIN = 4, 5e-4, 2
#: Least photos of one size that are compared, and how many of them.
MIN_PHOTOS, SAMPLED_PHOTOS = 3, 8


class UsablePixels:
    """Masks of the pixels of posed photos to take colours from."""

    def __init__(self, posed: PosedPhotos) -> None:
        groups: dict[tuple[int, int], list[int]] = {}
        for index, camera in enumerate(posed.cameras.cameras):
            groups.setdefault((camera.width, camera.height), []).append(index)
        self._black = {size: black for size, members in groups.items() if (black := _common_black(posed, members)) is not None}
        self._sizes = [(camera.width, camera.height) for camera in posed.cameras.cameras]

    def mask(self, index: int, view: View) -> Bytes | None:
        """The pixels (h, w; 255) of photo `index` to use, inside its mask if it has one; None for all. `view` may be reduced."""
        tight = None if view.mask is None else np.where(background_band(view.rgb, view.mask), 0, view.mask).astype(np.uint8)
        black = self._black.get(self._sizes[index])
        if black is None:
            return tight
        small = cv2.resize(black.astype(np.float32), (view.camera.width, view.camera.height), interpolation=cv2.INTER_AREA) > 0
        return np.where(small, 0, 255 if tight is None else tight).astype(np.uint8)


def _common_black(posed: PosedPhotos, members: Sequence[int]) -> Flags | None:
    """Black at the frame (h, w) that all photos of one size show at the same place, judged by some of them; None where there is none."""
    if len(members) < MIN_PHOTOS:
        return None
    common: Flags | None = None
    for k in np.unique(np.linspace(0, len(members) - 1, SAMPLED_PHOTOS).round().astype(int)):
        view = posed.view(members[k])
        black = black_at_frame(view.rgb, view.mask)
        common = black if common is None else common & black
        if common.mean() < MIN_BLACK_SHARE:
            return None
    size = 2 * BLACK_MARGIN + 1
    return None if common is None else np.asarray(cv2.dilate(common.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)


def background_band(rgb: Bytes, mask: Bytes) -> Flags:
    """Pixels (h, w) at the edge of the mask that have the colour of the background beside it, and the mixed ones next to them.

    Parts thinner than the band keep theirs: there is no way to tell them from background.
    """
    whole = np.zeros(mask.shape, np.bool_)
    width = max(3.0, BAND * max(mask.shape))
    left, top, across, down = cv2.boundingRect((mask > 127).astype(np.uint8))
    margin = int(2 * width + 2 * BACKGROUND_DISTANCE)
    box = slice(max(0, top - margin), top + down + margin), slice(max(0, left - margin), left + across + margin)
    whole[box] = _band(rgb[box], mask[box] > 127, width)
    return whole


def _band(rgb: Bytes, inside: Flags, width: float) -> Flags:
    """`background_band` of `width` pixels in the part of a photo around its mask."""
    depth = _distance(inside)
    band = (depth > 0) & (depth <= width) & (_distance(depth <= width) <= width + 2)
    clear = _distance(~inside) >= BACKGROUND_DISTANCE
    if not band.any() or not clear.any():
        return np.zeros(band.shape, np.bool_)
    distance, labels = cv2.distanceTransformWithLabels(
        (~clear).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    beside = np.zeros(int(labels.max()) + 1, np.int64)
    background = np.flatnonzero(clear.ravel())
    beside[labels.ravel()[background]] = background
    at = np.flatnonzero(band.ravel() & (distance.ravel() < 2 * width + BACKGROUND_DISTANCE))
    colours = rgb.reshape(-1, 3)
    similar = np.abs(colours[at].astype(np.int16) - colours[beside[labels.ravel()[at]]]).max(1) <= SAME_COLOUR
    same = np.zeros(band.shape, np.bool_)
    same.ravel()[at[similar]] = True
    joined = _touching(same, depth <= 1.5)
    return np.asarray(band & (cv2.dilate(joined.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))


def black_at_frame(rgb: Bytes, mask: Bytes | None) -> Flags:
    """Black regions (h, w) that touch the frame, inside the mask if there is one: black objects do not end there."""
    black = rgb.max(2) <= BLACK
    if mask is not None:
        black &= mask > 127
    frame = np.zeros(black.shape, np.bool_)
    frame[[0, -1]] = frame[:, [0, -1]] = True
    return _touching(black, frame)


def _touching(flags: Flags, seeds: Flags) -> Flags:
    """The connected regions of `flags` (h, w) in which there are `seeds`."""
    seeded = flags & seeds
    if not seeded.any():
        return seeded
    count, labels = cv2.connectedComponents(flags.astype(np.uint8), connectivity=8)
    chosen = np.zeros(count, np.bool_)
    chosen[labels[seeded]] = True
    return np.asarray(chosen[labels])


def _distance(flags: Flags) -> NDArray[np.float32]:
    """Distance (h, w) in pixels of pixels that are set from those that are not."""
    return np.asarray(cv2.distanceTransform(flags.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5), np.float32)
