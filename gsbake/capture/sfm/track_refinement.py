"""Observations of tie points placed to a tenth of a pixel, by aligning what the photos show around them.

SIFT places a feature in each photo by itself, to about half a pixel. Here one photo of each track, the one that sees the point most
frontally, gives a patch, which is found again in the others (`patch_alignment`). The idea is that of Lindenberger et al., *Pixel-perfect
structure-from-motion with featuremetric refinement*, ICCV 2021, with brightness in place of learnt features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.poses.colmap_model import camera_of
from gsbake.capture.sfm.patch_alignment import HALF, align_patches, cut_patches
from gsbake.geometry.cameras import Camera
from gsbake.imaging.png import read_grey

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Longest tracks that are refined: their patches take 200 MB.
MAX_TRACKS = 100_000
#: Bytes of decoded photos that are kept.
MAX_KEPT = 1 << 30
#: Smallest correlation with the patch, and largest way from SIFT's position in pixels of the photos in which features were detected.
MIN_CORRELATION, MAX_WAY = 0.7, 4.0
#: Detail beyond the photos in which features were detected from which a second round aligns at full size.
MIN_DETAIL = 1.3


@dataclass(frozen=True)
class Observations:
    """Observations of tracks, by track: their `track`, which photo and which of its features (n,), and the positions `xy` (n, 2).

    `images` are the photos' identifiers in the model, `track_ids` those of the tracks; `points` (m, 3) are the tracks' positions.
    """

    images: Sequence[int]
    track_ids: Indices
    points: Doubles
    track: Indices
    photo: Indices
    feature: Indices
    xy: Doubles

    @staticmethod
    def of(model: Any) -> Observations:
        """The observations of the longest tracks of a COLMAP reconstruction."""
        images = sorted(key for key, image in model.images.items() if image.has_pose)
        number = {key: k for k, key in enumerate(images)}
        lengths = {key: point.track.length() for key, point in model.points3D.items()}
        ids = sorted(sorted(lengths, key=lambda key: (-lengths[key], key))[:MAX_TRACKS])
        rows = [
            (t, number[element.image_id], element.point2D_idx)
            for t, key in enumerate(ids)
            for element in sorted(model.points3D[key].track.elements, key=lambda e: (e.image_id, e.point2D_idx))
        ]
        track, photo, feature = np.array(rows, np.int64).reshape(-1, 3).T
        xy = np.array([model.images[images[p]].points2D[f].xy for p, f in zip(photo, feature, strict=True)], float).reshape(-1, 2)
        points = np.array([model.points3D[key].xyz for key in ids], float).reshape(-1, 3)
        return Observations(images, np.array(ids, np.int64), points, track, photo, feature, xy)


@dataclass(frozen=True)
class Refined:
    """Positions `xy` (n, 2) of the observations, and which of them (n,) were `refined`: aligned ones and those that gave the patch."""

    xy: Doubles
    refined: NDArray[np.bool_]


def refine_observations(model: Any, observed: Observations, photos: Path, detected_size: int, tick: Callable[[int, int], None]) -> Refined:
    """Align the observations of a COLMAP reconstruction; its `photos` lie in a folder. `tick(done, total)` reports progress.

    `detected_size`: the longer side in pixels of the photos in which features were detected. Larger photos are aligned at that size first.
    An observation whose patch fits nowhere nearby keeps its position.
    """
    cameras = [camera_of(model.images[key], model.images[key].name, "the solved model") for key in observed.images]
    detail = max((max(c.width, c.height) / detected_size for c in cameras), default=1.0)
    rounds = [detected_size, None] if detail > MIN_DETAIL else [None]
    reference, normals = _references(cameras, observed)
    xy, good = observed.xy, np.ones(len(observed.xy), np.bool_)
    for k, size in enumerate(rounds):
        one = _Round(cameras, observed, reference, normals, photos, size)
        xy, good = one.align(xy, lambda done, total, k=k: tick(done + k * total, total * len(rounds)))  # type: ignore[misc]
    way = np.linalg.norm(xy - observed.xy, axis=1)
    scale = np.array([max(1.0, max(c.width, c.height) / detected_size) for c in cameras])[observed.photo]
    good &= way <= MAX_WAY * scale
    alone = np.bincount(observed.track[good], minlength=len(observed.points)) < 2
    good &= ~alone[observed.track]
    return Refined(np.where(good[:, None], xy, observed.xy), good)


def _references(cameras: Sequence[Camera], observed: Observations) -> tuple[NDArray[np.bool_], Doubles]:
    """Which observations (n,) give their tracks' patches, and the tracks' normals (m, 3): the mean direction to the cameras."""
    centres = np.stack([c.centre for c in cameras])
    to_camera = centres[observed.photo] - observed.points[observed.track]
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    normals = np.zeros_like(observed.points)
    np.add.at(normals, observed.track, to_camera)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    frontal = (to_camera * normals[observed.track]).sum(1)
    order = np.lexsort((np.arange(len(frontal)), -frontal, observed.track))
    reference = np.zeros(len(frontal), np.bool_)
    reference[order[np.unique(observed.track[order], return_index=True)[1]]] = True
    return reference, normals


class _Round:
    """One alignment of all observations, in photos reduced to `size` pixels at the longer side (None: full size)."""

    def __init__(
        self, cameras: Sequence[Camera], observed: Observations, reference: NDArray[np.bool_], normals: Doubles, photos: Path,
        size: int | None,
    ) -> None:  # fmt: skip
        self.cameras = [camera if size is None else camera.downscaled_to(size) for camera in cameras]
        self.scale = np.array([[small.width / c.width, small.height / c.height] for small, c in zip(self.cameras, cameras, strict=True)])
        self.observed, self.reference, self.normals = observed, reference, normals
        pixels = max(c.width * c.height for c in self.cameras)

        @lru_cache(maxsize=max(1, MAX_KEPT // pixels))
        def photo(k: int) -> NDArray[np.uint8]:
            camera, grey = self.cameras[k], read_grey(photos / cameras[k].name)
            if grey.shape != (camera.height, camera.width):
                grey = np.asarray(cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)
            return grey

        self._photo = photo

    def align(self, xy: Doubles, tick: Callable[[int, int], None]) -> tuple[Doubles, NDArray[np.bool_]]:
        """Positions (n, 2) from the first guess `xy` (n, 2), at full size, and which (n,) of them fit their track's patch."""
        o, tracks = self.observed, len(self.observed.points)
        found, good = xy.copy(), np.zeros(len(xy), np.bool_)
        patches, corners = np.zeros((tracks, 2 * HALF + 3, 2 * HALF + 3), np.float32), np.zeros((tracks, 4, 3))
        usable = np.zeros(tracks, np.bool_)
        total = 2 * len(self.cameras)
        for k in range(len(self.cameras)):
            rows = np.flatnonzero(self.reference & (o.photo == k))
            centres = xy[rows] * self.scale[k]
            track = o.track[rows]
            patches[track], usable[track] = cut_patches(self._photo(k).astype(np.float32), centres)
            corners[track] = _plane_corners(self.cameras[k], centres, o.points[track], self.normals[track])
            good[rows] = usable[track]
            tick(k + 1, total)
        for k in range(len(self.cameras)):
            rows = np.flatnonzero(~self.reference & (o.photo == k) & usable[o.track])
            track = o.track[rows]
            pixels, depth = self.cameras[k].project(corners[track].reshape(-1, 3))
            pixels = pixels.reshape(-1, 4, 2)
            affine = np.stack([pixels[:, 0] - pixels[:, 1], pixels[:, 2] - pixels[:, 3]], -1) / (2 * HALF)
            placed, correlation = align_patches(self._photo(k).astype(np.float32), patches, track, xy[rows] * self.scale[k], affine)
            good[rows] = (correlation >= MIN_CORRELATION) & (depth.reshape(-1, 4) > 0).all(1)
            found[rows] = placed / self.scale[k]
            tick(len(self.cameras) + k + 1, total)
        return np.where(good[:, None], found, xy), good


def _plane_corners(camera: Camera, centres: Doubles, points: Doubles, normals: Doubles) -> Doubles:
    """Points (n, 4, 3) of the planes through `points` (n, 3) at HALF pixels right, left, below and above of `centres` (n, 2)."""
    offsets = HALF * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
    plane = (centres[:, None] + offsets - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.concatenate([plane, np.ones((*plane.shape[:2], 1))], -1) @ camera.R
    distance = ((points - camera.centre) * normals).sum(1)[:, None]
    slant = np.einsum("nkc,nc->nk", rays, normals)
    return np.asarray(camera.centre + (distance / np.where(np.abs(slant) < 1e-9, 1e-9, slant))[..., None] * rays)
