"""Photos as stereo sees them: 8-bit grey at several sizes, where the object is, and cameras to match."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.ncc import RADIUS, pack

Bytes = NDArray[np.uint8]

#: Longer side that the coarsest level does not go below.
COARSEST = 120
#: Masks are widened by this many pixels: their edge is that uncertain.
WIDEN = 1


@dataclass(frozen=True)
class Photo:
    """One photo at one size: `grey` (h, w), `inside` (h, w) 1 where the object may be, its pinhole camera."""

    camera: Camera
    grey: Bytes
    inside: Bytes

    def halved(self) -> Photo:
        """The same at half the size (area filter); a pixel is inside when at least half of it is."""
        width, height = max(1, self.camera.width // 2), max(1, self.camera.height // 2)
        grey = cv2.resize(self.grey, (width, height), interpolation=cv2.INTER_AREA)
        inside = cv2.resize(self.inside * np.uint8(255), (width, height), interpolation=cv2.INTER_AREA)
        return Photo(self.camera.scaled(width, height), np.asarray(grey, np.uint8), (inside >= 128).astype(np.uint8))


def load_photo(posed: PosedPhotos, index: int, max_size: int) -> Photo:
    """Photo `index` of a capture with the longer side at most `max_size`; everything is inside where there is no mask."""
    view = posed.view(index, max_size)
    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    if view.mask is None:
        inside = np.ones(grey.shape, np.uint8)
    else:
        box = np.ones((2 * WIDEN + 1, 2 * WIDEN + 1), np.uint8)
        inside = np.asarray(cv2.dilate((view.mask > 127).astype(np.uint8), box), np.uint8)
    return Photo(view.camera, np.asarray(grey, np.uint8), inside)


def levels(photo: Photo, most: int = 3) -> list[Photo]:
    """The photo at up to `most` sizes, each half of the next, coarsest first."""
    out = [photo]
    while len(out) < most and max(out[-1].camera.width, out[-1].camera.height) >= 2 * COARSEST:
        out.append(out[-1].halved())
    return out[::-1]


@dataclass(frozen=True)
class Pair:
    """What the kernels read of one reference and its neighbours at one size (see `cost.match` for the layouts).

    `grey`, `inside` have a border of RADIUS; `lens` (4,) and `lenses` (k, 12) are single precision; `baseline` is the median length of
    the translations between the views, in world units.
    """

    grey: Bytes
    inside: Bytes
    lens: NDArray[np.float32]
    lenses: NDArray[np.float32]
    packed: NDArray[np.uint32]
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    baseline: float

    @staticmethod
    def of(photo: Photo, others: Sequence[Photo]) -> Pair:
        """Reference `photo` with its neighbours, all at the same level."""
        camera = photo.camera
        lenses, lengths = [], []
        for other in others:
            rotation, translation = relative(camera, other.camera)
            shifted = other.camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
            lenses.append(np.concatenate([(shifted @ rotation).ravel(), shifted @ translation]))
            lengths.append(float(np.linalg.norm(translation)))
        words = [pack(other.grey).ravel() for other in others]
        return Pair(
            np.pad(photo.grey, RADIUS, mode="edge"),
            np.pad(photo.inside, RADIUS),
            np.array([camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5], np.float32),
            np.array(lenses, np.float32).reshape(-1, 12),
            np.concatenate(words),
            np.concatenate([[0], np.cumsum([len(w) for w in words])[:-1]]).astype(np.int64),
            np.array([(o.camera.width, o.camera.height) for o in others], np.int64).reshape(-1, 2),
            float(np.median(lengths)),
        )


def relative(first: Camera, second: Camera) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) from the first camera's frame to the second's."""
    rotation = second.R @ first.R.T
    return rotation, second.t - rotation @ first.t


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV without threads of its own: views are shared among threads already."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
