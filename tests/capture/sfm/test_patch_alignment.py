"""Patches found again in another photo: the kernel against a plain twin in float64, and against where they truly lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from gsbake.capture.sfm.patch_alignment import (
    EDGE,
    HALF,
    LAST_STEP,
    LONGEST_STEP,
    MAX_STEPS,
    SIGMA,
    align_patches,
    cut_patches,
)

Doubles = NDArray[np.float64]


def texture(seed: int, size: int = 120) -> NDArray[np.float32]:
    return np.asarray(128 + 400 * gaussian_filter(np.random.default_rng(seed).normal(0, 1, (size, size)), 1.8), np.float32)


def warped(photo: NDArray[np.float32], affine: Doubles, shift: Doubles) -> NDArray[np.float32]:
    """The photo that shows at `affine` @ u + `shift` what this one shows at u, with another exposure."""
    row, column = np.mgrid[0 : photo.shape[0], 0 : photo.shape[1]] + 0.5
    source = np.linalg.inv(affine) @ (np.stack([column.ravel(), row.ravel()]) - shift[:, None])
    values = map_coordinates(photo.astype(float), source[::-1] - 0.5, order=3, mode="nearest")
    return np.asarray(0.7 * values.reshape(photo.shape) + 12, np.float32)


def plain_alignment(photo: Any, patch: Any, start: Any, affine: Any) -> tuple[Doubles, float]:
    """Inverse compositional Gauss-Newton with arrays in float64; for patches with contrast that stay in the photo."""
    v, u = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
    weight = np.exp(-(u**2 + v**2) / (2 * SIGMA**2))
    weight /= weight.sum()
    patch = patch.astype(float)
    target = patch[1:-1, 1:-1] - (weight * patch[1:-1, 1:-1]).sum()
    along, down = (patch[1:-1, 2:] - patch[1:-1, :-2]) / 2, (patch[2:, 1:-1] - patch[:-2, 1:-1]) / 2
    slopes = np.stack([along, down, along * u, along * v, down * u, down * v])
    energy = (weight * target**2).sum()
    slopes = np.stack([s - (weight * s).sum() - (weight * s * target).sum() / energy * target for s in slopes])
    normal = np.einsum("phw,qhw,hw->pq", slopes, slopes, weight)
    place, warp, correlation = np.array(start) - 0.5, np.array(affine), -1.0
    for _ in range(MAX_STEPS):
        x, y = place[0] + warp[0, 0] * u + warp[0, 1] * v, place[1] + warp[1, 0] * u + warp[1, 1] * v
        value = map_coordinates(photo.astype(float), [y, x], order=1)
        value -= (weight * value).sum()
        square = (weight * value**2).sum()
        correlation = float((weight * value * target).sum() / np.sqrt(square * energy))
        step = np.linalg.solve(normal, np.einsum("phw,hw->p", slopes, weight * (np.sqrt(energy / square) * value - target)))
        warp = warp @ np.linalg.inv(np.eye(2) + step[2:].reshape(2, 2))
        length = float(np.linalg.norm(step[:2]))
        place = place - min(1.0, LONGEST_STEP / length) * warp @ step[:2]
        if length < LAST_STEP:
            break
    return place + 0.5, correlation


AFFINE = np.array([[1.05, 0.12], [-0.08, 0.93]])


@pytest.mark.parametrize("seed", range(4))
def test_patches_are_found_as_by_the_twin_and_where_they_lie(seed: int) -> None:
    photo = texture(seed)
    shift = np.array([3.3, -1.7]) - (AFFINE - np.eye(2)) @ (60, 60)
    other = warped(photo, AFFINE, shift)
    rng = np.random.default_rng(seed)
    centres = rng.uniform(45, 75, (20, 2))
    true = centres @ AFFINE.T + shift
    start = true + rng.uniform(-1, 1, true.shape)
    patches, inside = cut_patches(photo, centres)
    assert inside.all() and patches.shape == (20, EDGE, EDGE)
    found, correlation = align_patches(other, patches, np.arange(20), start, np.tile(np.eye(2), (20, 1, 1)))
    for k in range(20):
        place, fit = plain_alignment(other, patches[k], start[k], np.eye(2))
        assert np.abs(found[k] - place).max() < 2e-3 and abs(correlation[k] - fit) < 1e-3
    assert correlation.min() > 0.98
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.03 < 0.3 < np.median(np.linalg.norm(start - true, axis=1))


def test_what_cannot_be_aligned_fits_nowhere() -> None:
    photo = texture(1)
    photo[:50, :50] = 90
    centres = np.array([[25.0, 25.0], [60.0, 60.0], [4.0, 60.0]])
    patches, inside = cut_patches(photo, centres)
    assert inside.tolist() == [True, True, False]
    start = np.array([[25.0, 25.0], [118.0, 60.0], [60.0, 60.0]])
    found, correlation = align_patches(photo, patches, np.array([0, 1, 1]), start, np.tile(np.eye(2), (3, 1, 1)))
    assert correlation[:2].tolist() == [-1.0, -1.0]  # no contrast; beyond the border
    assert found[0].tolist() == start[0].tolist()
    assert correlation[2] > 0.999 and np.abs(found[2] - centres[1]).max() < 1e-3
