"""Agreement between photos repairs guessed masks.

A network that sees one photo at a time errs in single photos: it takes a shadow, a label or a part for the object. Under true cameras the
silhouettes of one rigid object have a common visual hull (Laurentini, *The visual hull concept*, PAMI 1994), so the photos vote: a point
belongs to the object when at least 90 % of the photos that see it call it so (probabilistic variants: Franco & Boyer, *Fusion of
multi-view silhouette cues using a space occupancy grid*, ICCV 2005). A mask that differs much from the silhouette of this hull is
corrected: outside the dilated silhouette nothing is the object, inside the eroded one everything is. The border stays that of the guess,
which is finer than a voxel. Where hull and guesses do not agree, the cameras are wrong or the photos show no common object, and the guesses
are of no use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.masks.completion import render_silhouette
from gsbake.capture.photos.decode import Bytes
from gsbake.capture.photos.undistortion import intrinsics_key, pinhole_camera, remap_tables, resample, undistort_points
from gsbake.capture.poses.normalisation import bounding_sphere_from_masks
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.imaging.png import read_grey

#: Shares of a point's views that may call it background, tried in turn: a stricter vote is finer, a more lenient one finds the object where
#: many photos err as a whole. Photos that err do not vote in the next pass, which is no more lenient than MAX_OUTVOTED_SHARE.
FIRST_OUTVOTED_SHARES, MAX_OUTVOTED_SHARE = (0.1, 0.03, 0.25), 0.1
#: Overlap of guess and silhouette below which a photo does not vote in the next pass; passes after the first.
MIN_TRUSTED_OVERLAP, PASSES = 0.5, 2
#: Agreement from which no other share is tried, and below which guesses are not used as masks: a hull that many photos contradict loses
#: thin parts (an ear of the fox, whose guesses agree to .83), and without masks nothing is lost.
GOOD_AGREEMENT, MIN_USED_AGREEMENT = 0.9, 0.88
#: Longer side in pixels of the masks that vote, and cells along an edge of the hull's grid.
VOTE_SIZE, CELLS = 256, 96
#: Overlap of guess and silhouette below which a guess is corrected, and below which a person should look at it.
MIN_OVERLAP, MIN_CERTAIN_OVERLAP = 0.9, 0.75
#: Width of the band around the silhouette that is left to the guess, as a share of the root of the silhouette's area.
BAND = 0.04


@dataclass(frozen=True)
class Consensus:
    """Result of a vote: per photo the `silhouettes` (h, w) of the voted hull, and the `overlap` (n,) of guess and silhouette (intersection
    over union). Silhouettes are at VOTE_SIZE, without the lens's distortion."""

    silhouettes: list[NDArray[np.bool_]]
    overlap: NDArray[np.float64]

    @property
    def agreement(self) -> float:
        """Median overlap, 0 … 1."""
        return float(np.median(self.overlap))


def find_consensus(cameras: Sequence[Camera], masks: Mapping[str, Path]) -> Consensus | None:
    """The vote of all photos; None where the masks have no common object or the distortion cannot be inverted.

    `masks` are files by photo name, 255 = object, of any size with the photo's aspect ratio. Photos that do not vote in the end get their
    silhouettes too.
    """
    try:
        pinholes, guesses = small_views(cameras, masks)
    except BadInputError:
        return None
    best: Consensus | None = None
    for share in FIRST_OUTVOTED_SHARES:
        found = _vote(pinholes, guesses, share)
        if found is not None and (best is None or found.agreement > best.agreement):
            best = found
        if best is not None and best.agreement >= GOOD_AGREEMENT:
            break
    return best


def _vote(cameras: list[Camera], guesses: list[Bytes], share: float) -> Consensus | None:
    """The best of a first vote under `share` and of the passes after it; None where nothing is left of the hull."""
    voters = list(range(len(cameras)))
    best: Consensus | None = None
    for _ in range(1 + PASSES):
        chosen = [cameras[i] for i in voters], [guesses[i] for i in voters]
        sphere = bounding_sphere_from_masks(*chosen, share)
        if sphere is None:
            break
        hull = Hull.from_masks(*chosen, sphere.centre, sphere.radius, CELLS, share)
        silhouettes = [render_silhouette(hull, camera) for camera in cameras]
        overlap = np.array([intersection_over_union(g > 127, s) for g, s in zip(guesses, silhouettes, strict=True)])
        found = Consensus(silhouettes, overlap)
        best = found if best is None or found.agreement > best.agreement else best
        trusted = np.flatnonzero(overlap >= MIN_TRUSTED_OVERLAP).tolist()
        if len(trusted) < 3 or (trusted == voters and share <= MAX_OUTVOTED_SHARE):
            break
        voters, share = trusted, min(share, MAX_OUTVOTED_SHARE)
    return best


def correct_mask(guess: Bytes, silhouette: NDArray[np.bool_], overlap: float) -> Bytes:
    """The `guess` (h, w) corrected by the `silhouette` of the voted hull, which has a smaller size (h', w'); `overlap` is that of the two.

    The guess as it is where they agree. Else limited to the dilated silhouette and completed by the eroded one. The silhouette itself where
    the guess has taken something else for the object.
    """
    if overlap >= MIN_OVERLAP:
        return guess
    shape = 255 * silhouette.astype(np.uint8)
    radius = max(1, round(BAND * float(np.sqrt(np.count_nonzero(silhouette)))))
    if overlap < MIN_TRUSTED_OVERLAP:
        smooth = cv2.GaussianBlur(shape, (0, 0), 0.5 * radius)  # rows of cells show where the camera is near
        return np.asarray(cv2.resize(smooth, guess.shape[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)
    disc = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
    # The frame's edge is no silhouette: what it cuts off is neither grown nor shrunk there (OpenCV's default border).
    limits = cv2.dilate(shape, disc), cv2.erode(shape, disc)
    outer, inner = (cv2.resize(limit, guess.shape[::-1], interpolation=cv2.INTER_LINEAR) for limit in limits)
    return np.where(inner > 127, 255, np.where(outer > 127, guess, 0)).astype(np.uint8)


def distorted(silhouette: NDArray[np.bool_], camera: Camera, size: int = VOTE_SIZE) -> NDArray[np.bool_]:
    """The `silhouette` (h, w) of the pinhole of a small view as the photo of `camera` shows it, with the lens's distortion, at `size`."""
    small = camera.downscaled_to(size)
    if not any(camera.distortion):
        return silhouette
    shape = resample(255 * silhouette.astype(np.uint8), _distorted_positions(intrinsics_key(small)), mask=True)
    return np.asarray(shape > 127)


@lru_cache(maxsize=4)
def _distorted_positions(intrinsics: tuple[float, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where the pinhole image shows each pixel of the photo (h, w) with these `intrinsics` (of `intrinsics_key`); −1 where it does not."""
    width, height, fx, fy, cx, cy, *distortion = intrinsics
    camera = Camera("", int(width), int(height), fx, fy, cx, cy, np.eye(3), np.zeros(3), tuple(distortion))
    pinhole = pinhole_camera(camera)
    x, y = (np.arange(camera.width) + 0.5 - cx) / fx, (np.arange(camera.height) + 0.5 - cy) / fy
    plane = undistort_points(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2), camera.distortion).reshape(camera.height, camera.width, 2)
    positions = plane * (pinhole.fx, pinhole.fy) + (pinhole.cx - 0.5, pinhole.cy - 0.5)
    columns, rows = (np.ascontiguousarray(np.nan_to_num(positions[..., k], nan=-1.0), np.float32) for k in (0, 1))
    return columns, rows


def small_views(cameras: Sequence[Camera], masks: Mapping[str, Path], size: int = VOTE_SIZE) -> tuple[list[Camera], list[Bytes]]:
    """Pinhole cameras reduced to `size` and their undistorted masks (h, w). Raises BadInputError as `pinhole_camera` does."""
    views = [_small_view(camera, masks[camera.name], size) for camera in cameras]
    return [camera for camera, _ in views], [mask for _, mask in views]


def _small_view(camera: Camera, file: Path, size: int) -> tuple[Camera, Bytes]:
    """The pinhole camera reduced to `size` and its undistorted mask (h, w). Raises BadInputError as `pinhole_camera` does."""
    small = camera.downscaled_to(size)
    mask: Any = cv2.resize(read_grey(file), (small.width, small.height), interpolation=cv2.INTER_AREA)
    pinhole = pinhole_camera(small)
    if any(camera.distortion):
        mask = resample(np.asarray(mask, np.uint8), remap_tables(small, pinhole), mask=True)
    return pinhole, np.asarray(mask, np.uint8)


def intersection_over_union(mask: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks (h, w); 0 where both are empty."""
    union = np.count_nonzero(mask | other)
    return np.count_nonzero(mask & other) / union if union else 0.0
