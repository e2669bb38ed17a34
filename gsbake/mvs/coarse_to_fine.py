"""Coarse-to-fine PatchMatch of one photo: a plane and a cost for every pixel.

At the coarsest size planes are initialised at random between the bounds, at tie points and on the hull, and matched against every source
view. Each finer size starts from the upsampled planes, selects the best source views per pixel and matches against only those. Pixels that
already match well are only refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.mvs.ncc import SamplingPattern
from gsbake.mvs.patchmatch import evaluate_planes, interpolate_planes, refine_planes, sweep
from gsbake.mvs.pyramids import MatchingViews, Photo

Floats = NDArray[np.float32]

#: Sweeps at the coarsest size, at finer sizes and at the full size.
COARSE_SWEEPS, FINE_SWEEPS, FULL_SWEEPS = 4, 1, 1
#: Largest random perturbation in the first sweep at the coarsest and at finer sizes (pixels of disparity); halved after each sweep.
COARSE_PERTURBATION, FINE_PERTURBATION = 4.0, 1.0
#: Random perturbations per pixel and sweep.
RANDOM_TRIALS = 3
#: Farther propagation candidates per direction, up to 2 FAR_CANDIDATES + 1 pixels away.
FAR_CANDIDATES = 4
#: Parabolic refinement: first step in pixels of disparity, iterations, and the cost above which pixels are skipped.
REFINE_STEP, REFINE_ITERATIONS, REFINE_MAX_COST = 0.4, 1, 0.6
#: Match half of the pixels at the full size, in a checkerboard (1), or all (0). The others are interpolated from neighbours whose inverse
#: depths differ by less than this share.
CHECKERBOARD, MAX_INTERPOLATION_GAP = 1, 0.003
#: Share of random planes initialised near the near bound (the hull's surface) instead of anywhere behind it.
NEAR_BOUND_SHARE = 0.5


@dataclass(frozen=True)
class Planes:
    """Planes of one photo: `plane` (h, w, 3) with plane·(x, y, 1) = 1/z, and `cost` (h, w) = mean 1 − NCC, 1 where nothing matched."""

    plane: Floats
    cost: Floats


def normalised_coordinates(photo: Photo) -> tuple[Floats, Floats]:
    """Normalised coordinates (w,), (h,) of pixel centres."""
    camera = photo.camera
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return x.astype(np.float32), y.astype(np.float32)


def initial_planes(photo: Photo, low: Floats, high: Floats, seeds: Floats, rng: np.random.Generator) -> Floats:
    """Random planes (h, w, 3) within the bounds; half of the pixels with a seed use it, the others lie at the near bound or behind it."""
    shape = low.shape
    behind = np.where(rng.random(shape) < NEAR_BOUND_SHARE, 0.05, 1.0) * rng.random(shape)
    rho = high + (low - high) * behind
    seeded = (seeds >= low) & (seeds <= high) & (seeds > 0) & (rng.random(shape) < 0.5)
    rho = np.where(seeded, seeds, rho)
    x, y = normalised_coordinates(photo)
    ray = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), -1)
    normal = ray / np.linalg.norm(ray, axis=-1, keepdims=True) + 0.6 * rng.normal(size=(*shape, 3))
    facing = (normal * ray).sum(-1)
    normal = np.where((facing > 0.4 * np.linalg.norm(ray, axis=-1))[..., None], normal, ray)
    plane = normal * (rho / (normal * ray).sum(-1))[..., None]
    return np.ascontiguousarray(plane, np.float32)


def _upsample(planes: Floats, low: Floats, high: Floats, photo: Photo) -> tuple[Floats, Floats, Floats]:
    """Upsample planes and bounds to the size of `photo`; the bounds widen by one coarse pixel."""
    camera = photo.camera
    size = (camera.width, camera.height)
    known = high > 0
    # Pixels outside get the plane of the nearest pixel inside: the finer mask may be larger.
    _, label = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(int(label.max()) + 1, np.int64)
    source[label[known]] = np.flatnonzero(known)
    full = planes.reshape(-1, 3)[source[label]]
    box = np.ones((3, 3), np.uint8)
    wide_high = cv2.dilate(high, box)
    wide_low = np.where(known, low, np.float32(1e9))
    wide_low = np.asarray(cv2.erode(wide_low, box, borderType=cv2.BORDER_REPLICATE), np.float32)
    low = np.asarray(cv2.resize(wide_low, size, interpolation=cv2.INTER_NEAREST), np.float32)
    high = np.asarray(cv2.resize(wide_high, size, interpolation=cv2.INTER_NEAREST), np.float32)
    high = np.where(photo.inside > 0, high, 0).astype(np.float32)
    return np.ascontiguousarray(cv2.resize(full, size, interpolation=cv2.INTER_NEAREST)), low, high


def find_planes(
    photos: Sequence[Photo], others: Sequence[Sequence[Photo]], bounds: tuple[Floats, Floats], seeds: Floats, best_views: int, seed: int
) -> Planes:
    """Match one photo, given at several sizes (coarsest first), against the source photos `others` (each at the same sizes).

    `bounds` and `seeds` are those of the coarsest size (`depth_bounds.depth_bounds`, `depth_bounds.seed_depths`). Without source photos
    every cost is 1.
    """
    fine = photos[-1]
    if not others or not (bounds[1] > 0).any():
        shape = fine.grey.shape
        return Planes(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
    low, high = bounds
    plane = initial_planes(photos[0], low, high, seeds, np.random.default_rng(seed))
    cost = np.ones(low.shape, np.float32)
    for level, photo in enumerate(photos):
        if level:
            plane, low, high = _upsample(plane, low, high, photo)
        views = MatchingViews.of(photo, [o[level] for o in others])
        cost = _match_level(views, plane, (low, high), (level, len(photos)), min(best_views, len(others)), seed)
    return Planes(plane, cost)


def _match_level(
    matched: MatchingViews, plane: Floats, bounds: tuple[Floats, Floats], level_of: tuple[int, int], best_views: int, seed: int
) -> Floats:
    """Improve the planes (h, w, 3) in place at one size of the pyramid; return their costs (h, w). `level_of` is (level, levels)."""
    (low, high), (level, levels) = bounds, level_of
    full = level > 0 and level == levels - 1
    cost = np.ones(low.shape, np.float32)
    chosen_views = np.zeros(low.shape, np.uint8)
    reference = (matched.grey, matched.inside, matched.intrinsics, SamplingPattern.make().arrays)
    views = matched.sources
    pixel = np.float32(1 / (matched.intrinsics[0] * max(matched.baseline, 1e-9)))
    checkerboard = CHECKERBOARD if full else 0
    evaluate_planes(plane, cost, chosen_views, high, *reference, views, best_views, level > 0, checkerboard)
    sweeps = COARSE_SWEEPS if level == 0 else FULL_SWEEPS if full else FINE_SWEEPS
    perturbation = FINE_PERTURBATION if level else COARSE_PERTURBATION
    for iteration in range(sweeps):
        far = FAR_CANDIDATES if iteration == 0 or level == 0 else 0
        for colour in (0,) if checkerboard else (0, 1):
            state = (seed * 64 + level * 16 + iteration) * 2 + colour
            sweep(
                colour, state, plane, cost, chosen_views, low, high, *reference, views, best_views,
                pixel, np.float32(perturbation), RANDOM_TRIALS, far,
            )  # fmt: skip
        perturbation *= 0.5
    if level == 0 and levels > 1:
        return cost
    refine_planes(
        plane, cost, chosen_views, low, high, *reference, views, best_views,
        pixel, np.float32(REFINE_STEP), REFINE_ITERATIONS, np.float32(REFINE_MAX_COST), checkerboard,
    )  # fmt: skip
    if checkerboard:
        interpolate_planes(plane, cost, high, matched.intrinsics, np.float32(MAX_INTERPOLATION_GAP))
    return cost
