"""Distances against SciPy's exact transform, and the same bits wherever the result lies in memory."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import default_rng
from scipy import ndimage

from gsbake.imaging.distance import distance_to_zero


def blobs(size: int, seed: int) -> np.ndarray:
    return (cv2.GaussianBlur(default_rng(seed).random((size, size)).astype(np.float32), (0, 0), 9) > 0.5).astype(np.uint8)


def test_exact() -> None:
    image = blobs(200, 0)
    np.testing.assert_allclose(distance_to_zero(image), ndimage.distance_transform_edt(image), rtol=1e-6)
    assert np.array_equal(distance_to_zero(255 * image), distance_to_zero(image))


def test_the_same_bits_at_every_address() -> None:
    image, draw = blobs(96, 0), default_rng(1)
    kept: list[object] = []
    results = set()
    for _ in range(60):  # keeps results and scraps of memory, so that addresses differ
        kept.append([np.zeros(int(draw.integers(1, 60)), np.uint8) for _ in range(int(draw.integers(0, 7)))])
        found = distance_to_zero(image.copy())
        kept.append(found)
        results.add(found.tobytes())
    assert len(results) == 1
