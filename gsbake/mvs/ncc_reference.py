"""The matching cost written for reading, in NumPy and double precision: what `cost` is tested against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.mvs.ncc import NOISE, RADIUS, SAMPLES, SIGMA_GREY, SIGMA_PIXELS

Array = NDArray[np.float64]


def homography(first: Camera, second: Camera, normal: Array, distance: float) -> Array:
    """(3, 3) map of homogeneous pixels of `first` to those of `second` through the plane normalᵀX = distance in the first's frame."""
    rotation = second.R @ first.R.T
    translation = second.t - rotation @ first.t
    return np.asarray(second.K @ (rotation + np.outer(translation, normal) / distance) @ np.linalg.inv(first.K))


def offsets() -> Array:
    """Sample places (s, 2) as du, dv: seeds of a sunflower (Vogel, *A better way to construct the sunflower head*, 1979)."""
    places = []
    for k in range(SAMPLES):
        turn, length = np.radians((k + 0.5) * 137.50776405003785), (RADIUS + 0.3) * ((k + 0.5) / SAMPLES) ** 0.5
        places.append((np.rint(length * np.cos(turn)), np.rint(length * np.sin(turn))))
    return np.clip(places, -RADIUS, RADIUS)


def cost(
    grey: NDArray[np.uint8], inside: NDArray[np.bool_], pixel: tuple[int, int], other: NDArray[np.uint8], mapping: Array
) -> float | None:
    """1 − NCC of the patch at `pixel` (v, u) of `grey` (h, w) against `other` through homography `mapping`; None where it leaves that view.

    The homography is applied by its value and derivative at the pixel's middle; `inside` (h, w) tells which pixels may be compared.
    """
    v, u = pixel
    places = offsets()
    rows, columns = v + places[:, 1].astype(int), u + places[:, 0].astype(int)
    exists = (rows >= 0) & (columns >= 0) & (rows < grey.shape[0]) & (columns < grey.shape[1])
    rows, columns = rows.clip(0, grey.shape[0] - 1), columns.clip(0, grey.shape[1] - 1)
    here = grey[rows, columns].astype(float)
    weight = np.exp(-((here - float(grey[v, u])) ** 2) / (2 * SIGMA_GREY**2) - (places**2).sum(1) / (2 * SIGMA_PIXELS**2))
    weight *= exists & inside[rows, columns]
    weight /= weight.sum()
    middle = mapping @ [u + 0.5, v + 0.5, 1.0]
    point = middle[:2] / middle[2]
    jacobian = (mapping[:2, :2] - point[:, None] * mapping[2, :2]) / middle[2]
    there = point + places @ jacobian.T - 0.5
    reach = RADIUS * np.abs(jacobian).sum(1)
    if (point - 0.5 - reach < 0).any() or (point - 0.5 + reach >= np.array(other.shape[::-1]) - 1).any():
        return None
    corner = np.floor(there).astype(int)
    fx, fy = (there - corner).T
    pixels = other.astype(float)
    left, top = corner.T
    seen = (pixels[top, left] * (1 - fx) + pixels[top, left + 1] * fx) * (1 - fy)
    seen += (pixels[top + 1, left] * (1 - fx) + pixels[top + 1, left + 1] * fx) * fy
    gap = here - weight @ here
    variance = weight @ gap**2
    variance_there = weight @ seen**2 - (weight @ seen) ** 2
    return float(1 - weight @ (gap * seen) / np.sqrt((variance + float(NOISE)) * (variance_there + float(NOISE))))
