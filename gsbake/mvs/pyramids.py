"""Image pyramids for stereo: 8-bit grey photos with masks and cameras at several sizes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.ncc import RADIUS, pack_2x2

Bytes = NDArray[np.uint8]

#: Minimum longer side of the coarsest level in pixels.
COARSEST_SIZE = 120
#: Masks are dilated by this many pixels: the uncertainty of their edge.
MASK_DILATION = 1


@dataclass(frozen=True)
class Photo:
    """One photo at one size: pinhole `camera`, `grey` (h, w), and `inside` (h, w), the mask: 1 where the object may be."""

    camera: Camera
    grey: Bytes
    inside: Bytes

    def halved(self) -> Photo:
        """The photo at half the size (area filter); a pixel is inside where at least half of it is."""
        width, height = max(1, self.camera.width // 2), max(1, self.camera.height // 2)
        grey = cv2.resize(self.grey, (width, height), interpolation=cv2.INTER_AREA)
        inside = cv2.resize(self.inside * np.uint8(255), (width, height), interpolation=cv2.INTER_AREA)
        return Photo(self.camera.scaled(width, height), np.asarray(grey, np.uint8), (inside >= 128).astype(np.uint8))


def load_photo(photos: FullPhotos, index: int, max_size: int) -> Photo:
    """Photo `index` of a capture with the longer side at most `max_size`; without a mask all pixels are inside, but for those that
    do not show the region."""
    view = photos.view(index, max_size)
    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    if view.mask is None:
        inside = np.ones(grey.shape, np.uint8)
    else:
        box = np.ones((2 * MASK_DILATION + 1, 2 * MASK_DILATION + 1), np.uint8)
        inside = np.asarray(cv2.dilate((view.mask > 127).astype(np.uint8), box), np.uint8)
    if (region := photos.posed.region) is not None:
        inside &= region.silhouette(view.camera) // np.uint8(255)
    return Photo(view.camera, np.asarray(grey, np.uint8), inside)


def image_pyramid(photo: Photo, max_levels: int = 3) -> list[Photo]:
    """The photo at up to `max_levels` sizes, each half of the next, coarsest first."""
    out = [photo]
    while len(out) < max_levels and max(out[-1].camera.width, out[-1].camera.height) >= 2 * COARSEST_SIZE:
        out.append(out[-1].halved())
    return out[::-1]


@dataclass(frozen=True)
class MatchingViews:
    """One reference view and its source views at one size, laid out for the kernels (see `ncc.ncc_cost`).

    `grey`, `inside` have a border of RADIUS; `intrinsics` (4,) and `projections` (k, 12) are single precision; `baseline` is the median
    length of the translations between the views, in world units.
    """

    grey: Bytes
    inside: Bytes
    intrinsics: NDArray[np.float32]
    projections: NDArray[np.float32]
    packed: NDArray[np.uint32]
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    baseline: float

    @property
    def sources(self) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.int64], NDArray[np.int64]]:
        """The source views as the tuple `views` that kernels take."""
        return self.projections, self.packed, self.starts, self.sizes

    @staticmethod
    def of(photo: Photo, others: Sequence[Photo]) -> MatchingViews:
        """Reference `photo` with source photos `others`, all at the same level."""
        camera = photo.camera
        projections, lengths = [], []
        for other in others:
            rotation, translation = relative_pose(camera, other.camera)
            shifted = other.camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
            projections.append(np.concatenate([(shifted @ rotation).ravel(), shifted @ translation]))
            lengths.append(float(np.linalg.norm(translation)))
        words = [pack_2x2(other.grey).ravel() for other in others]
        return MatchingViews(
            np.pad(photo.grey, RADIUS, mode="edge"),
            np.pad(photo.inside, RADIUS),
            np.array([camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5], np.float32),
            np.array(projections, np.float32).reshape(-1, 12),
            np.concatenate(words),
            np.concatenate([[0], np.cumsum([len(w) for w in words])[:-1]]).astype(np.int64),
            np.array([(o.camera.width, o.camera.height) for o in others], np.int64).reshape(-1, 2),
            float(np.median(lengths)),
        )


def relative_pose(first: Camera, second: Camera) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) from the first camera's frame to the second's."""
    rotation = second.R @ first.R.T
    return rotation, second.t - rotation @ first.t


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Run OpenCV on one thread: each stereo thread processes a photo of its own."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
