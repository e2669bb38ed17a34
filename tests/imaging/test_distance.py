"""Distance transform against SciPy's exact one, and reproducible bits at any memory address."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import default_rng
from scipy import ndimage

from gsbake.imaging.distance import distance_to_zero


def blobs(size: int, seed: int) -> np.ndarray:
    return (cv2.GaussianBlur(default_rng(seed).random((size, size)).astype(np.float32), (0, 0), 9) > 0.5).astype(np.uint8)


def test_equals_scipy() -> None:
    image = blobs(200, 0)
    np.testing.assert_allclose(distance_to_zero(image), ndimage.distance_transform_edt(image), rtol=1e-6)
    assert np.array_equal(distance_to_zero(255 * image), distance_to_zero(image))


def test_equal_bits_at_every_address() -> None:
    image, rng = blobs(96, 0), default_rng(1)
    memory: list[object] = []
    results = set()
    for _ in range(60):  # allocations in between change the addresses
        memory.append([np.zeros(int(rng.integers(1, 60)), np.uint8) for _ in range(int(rng.integers(0, 7)))])
        found = distance_to_zero(image.copy())
        memory.append(found)
        results.add(found.tobytes())
    assert len(results) == 1
