"""Reference implementation of the matching cost in NumPy and double precision; the kernels of `ncc` are tested against it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.mvs.ncc import NOISE_VARIANCE, RADIUS, SAMPLES, SIGMA_GREY, SIGMA_PIXELS

Array = NDArray[np.float64]


def homography(first: Camera, second: Camera, normal: Array, distance: float) -> Array:
    """(3, 3) map of homogeneous pixels of `first` to those of `second` through the plane normalᵀX = distance in the first's frame."""
    rotation = second.R @ first.R.T
    translation = second.t - rotation @ first.t
    return np.asarray(second.K @ (rotation + np.outer(translation, normal) / distance) @ np.linalg.inv(first.K))


def offsets() -> Array:
    """Sample offsets (s, 2) as du, dv: a sunflower (Vogel, *A better way to construct the sunflower head*, 1979)."""
    samples = []
    for k in range(SAMPLES):
        angle, length = np.radians((k + 0.5) * 137.50776405003785), (RADIUS + 0.3) * ((k + 0.5) / SAMPLES) ** 0.5
        samples.append((np.rint(length * np.cos(angle)), np.rint(length * np.sin(angle))))
    return np.clip(samples, -RADIUS, RADIUS)


def ncc_cost_reference(
    grey: NDArray[np.uint8], inside: NDArray[np.bool_], pixel: tuple[int, int], other: NDArray[np.uint8], mapping: Array
) -> float | None:
    """1 − NCC of the patch at `pixel` (v, u) of `grey` (h, w) against `other` through homography `mapping`; None where it leaves that view.

    The homography is linearised at the pixel centre; `inside` (h, w) is the mask.
    """
    v, u = pixel
    samples = offsets()
    rows, columns = v + samples[:, 1].astype(int), u + samples[:, 0].astype(int)
    exists = (rows >= 0) & (columns >= 0) & (rows < grey.shape[0]) & (columns < grey.shape[1])
    rows, columns = rows.clip(0, grey.shape[0] - 1), columns.clip(0, grey.shape[1] - 1)
    own = grey[rows, columns].astype(float)
    weight = np.exp(-((own - float(grey[v, u])) ** 2) / (2 * SIGMA_GREY**2) - (samples**2).sum(1) / (2 * SIGMA_PIXELS**2))
    weight *= exists & inside[rows, columns]
    weight /= weight.sum()
    middle = mapping @ [u + 0.5, v + 0.5, 1.0]
    point = middle[:2] / middle[2]
    jacobian = (mapping[:2, :2] - point[:, None] * mapping[2, :2]) / middle[2]
    sampled = point + samples @ jacobian.T - 0.5
    reach = RADIUS * np.abs(jacobian).sum(1)
    if (point - 0.5 - reach < 0).any() or (point - 0.5 + reach >= np.array(other.shape[::-1]) - 1).any():
        return None
    corner = np.floor(sampled).astype(int)
    fx, fy = (sampled - corner).T
    pixels = other.astype(float)
    left, top = corner.T
    warped = (pixels[top, left] * (1 - fx) + pixels[top, left + 1] * fx) * (1 - fy)
    warped += (pixels[top + 1, left] * (1 - fx) + pixels[top + 1, left + 1] * fx) * fy
    gap = own - weight @ own
    variance = weight @ gap**2
    warped_variance = weight @ warped**2 - (weight @ warped) ** 2
    return float(1 - weight @ (gap * warped) / np.sqrt((variance + float(NOISE_VARIANCE)) * (warped_variance + float(NOISE_VARIANCE))))
