"""The plane of every pixel of one photo, coarse to fine.

At the coarsest size planes start at random between the bounds, at tie points and on the hull, and every neighbour is asked; each finer
size takes over the planes, notes per pixel the neighbours that fit best, and asks only those. Pixels that already match well
are not searched again, only refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.mvs.ncc import Pattern
from gsbake.mvs.patchmatch import fill, polish, settle, sweep
from gsbake.mvs.pyramids import Pair, Photo

Floats = NDArray[np.float32]

#: Sweeps at the coarsest size and at the finer ones, with the spread of the random steps (pixels of disparity) at the first of them.
COARSE_SWEEPS, FINE_SWEEPS, LAST_SWEEPS = 4, 1, 1
COARSE_SPREAD, FINE_SPREAD = 4.0, 1.0
#: Random steps per pixel and sweep.
TRIES = 3
#: How far along a row or column candidates are looked for: up to 2 FAR + 1 pixels.
FAR = 4
#: First step of the refinement in pixels of disparity, its rounds, and the cost from which on nothing is left to refine.
POLISH_STEP, POLISH_ROUNDS, POLISH_WORST = 0.4, 1, 0.6
#: At the full size every second pixel is matched (1) or all (0); the others take the mean of neighbours that agree to this share of depth.
THIN, FILL_SHARE = 1, 0.003
#: Share of random starts that lie on the near bound (the hull's surface) instead of behind it.
ON_BOUND = 0.5


@dataclass(frozen=True)
class Planes:
    """Result for one photo: `plane` (h, w, 3) with plane·(x, y, 1) = 1/z, and `cost` (h, w) = mean 1 − NCC, 1 where nothing matched."""

    plane: Floats
    cost: Floats


def normalised(photo: Photo) -> tuple[Floats, Floats]:
    """Normalised coordinates (w,), (h,) of pixel centres."""
    camera = photo.camera
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return x.astype(np.float32), y.astype(np.float32)


def initial_planes(photo: Photo, low: Floats, high: Floats, seeds: Floats, rng: np.random.Generator) -> Floats:
    """Random planes (h, w, 3) within the bounds; half of the pixels with a seed start there, others near the hull or behind it."""
    shape = low.shape
    behind = np.where(rng.random(shape) < ON_BOUND, 0.05, 1.0) * rng.random(shape)
    rho = high + (low - high) * behind
    seeded = (seeds >= low) & (seeds <= high) & (seeds > 0) & (rng.random(shape) < 0.5)
    rho = np.where(seeded, seeds, rho)
    x, y = normalised(photo)
    ray = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), -1)
    normal = ray / np.linalg.norm(ray, axis=-1, keepdims=True) + 0.6 * rng.normal(size=(*shape, 3))
    facing = (normal * ray).sum(-1)
    normal = np.where((facing > 0.4 * np.linalg.norm(ray, axis=-1))[..., None], normal, ray)
    plane = normal * (rho / (normal * ray).sum(-1))[..., None]
    return np.ascontiguousarray(plane, np.float32)


def _finer(planes: Floats, low: Floats, high: Floats, photo: Photo) -> tuple[Floats, Floats, Floats]:
    """Planes and bounds of a coarser size at the size of `photo`; the bounds widen by one coarse pixel."""
    camera = photo.camera
    size = (camera.width, camera.height)
    known = high > 0
    # Pixels outside take over the plane of the nearest pixel inside, as the finer mask may reach farther.
    _, label = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    place = np.zeros(int(label.max()) + 1, np.int64)
    place[label[known]] = np.flatnonzero(known)
    full = planes.reshape(-1, 3)[place[label]]
    box = np.ones((3, 3), np.uint8)
    wide_high = cv2.dilate(high, box)
    wide_low = np.where(known, low, np.float32(1e9))
    wide_low = np.asarray(cv2.erode(wide_low, box, borderType=cv2.BORDER_REPLICATE), np.float32)
    low = np.asarray(cv2.resize(wide_low, size, interpolation=cv2.INTER_NEAREST), np.float32)
    high = np.asarray(cv2.resize(wide_high, size, interpolation=cv2.INTER_NEAREST), np.float32)
    high = np.where(photo.inside > 0, high, 0).astype(np.float32)
    return np.ascontiguousarray(cv2.resize(full, size, interpolation=cv2.INTER_NEAREST)), low, high


def find_planes(
    photos: Sequence[Photo], others: Sequence[Sequence[Photo]], bounds: tuple[Floats, Floats], seeds: Floats, best_of: int, seed: int
) -> Planes:
    """Match one photo, given at several sizes (coarsest first), against `others` (each at the same sizes).

    `bounds` and `seeds` are those of the coarsest size (`bounds.depth_bounds`, `bounds.seed_depths`). Without neighbours every cost is 1.
    """
    fine = photos[-1]
    if not others or not (bounds[1] > 0).any():
        shape = fine.grey.shape
        return Planes(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
    pattern = Pattern.make()
    shape_of = (pattern.du, pattern.dv, pattern.near, pattern.alike)
    low, high = bounds
    plane = initial_planes(photos[0], low, high, seeds, np.random.default_rng(seed))
    best_of = min(best_of, len(others))
    cost = np.ones(low.shape, np.float32)
    for level, photo in enumerate(photos):
        if level:
            plane, low, high = _finer(plane, low, high, photo)
        pair = Pair.of(photo, [o[level] for o in others])
        cost = np.ones(low.shape, np.float32)
        bits = np.zeros(low.shape, np.uint8)
        reference = (pair.grey, pair.inside, pair.lens, shape_of)
        views = (pair.lenses, pair.packed, pair.starts, pair.sizes)
        pixel = np.float32(1 / (pair.lens[0] * max(pair.baseline, 1e-9)))
        thin = THIN if level and level == len(photos) - 1 else 0
        settle(plane, cost, bits, high, *reference, views, best_of, level > 0, thin)
        sweeps = COARSE_SWEEPS if level == 0 else LAST_SWEEPS if level == len(photos) - 1 else FINE_SWEEPS
        spread = FINE_SPREAD if level else COARSE_SPREAD
        for turn in range(sweeps):
            for colour in (0,) if thin else (0, 1):
                state = (seed * 64 + level * 16 + turn) * 2 + colour
                sweep(
                    colour, state, plane, cost, bits, low, high, *reference, views, best_of, pixel, np.float32(spread), TRIES,
                    FAR if turn == 0 or level == 0 else 0,
                )  # fmt: skip
            spread *= 0.5
        if level == 0 and len(photos) > 1:
            continue
        polish(
            plane,
            cost,
            bits,
            low,
            high,
            *reference,
            views,
            best_of,
            pixel,
            np.float32(POLISH_STEP),
            POLISH_ROUNDS,
            np.float32(POLISH_WORST),
            thin,
        )
        if thin:
            fill(plane, cost, high, pair.lens, np.float32(FILL_SHARE))
    return Planes(plane, cost)
