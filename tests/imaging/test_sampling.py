"""Bilinear sampling."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.imaging.sampling import bilinear_at_pixels


@pytest.mark.parametrize("count", [0, 1, 4096, 100_000])
def test_any_number_of_points(count: int) -> None:
    """A linear image is reproduced; OpenCV alone refuses lists of more than 32 766 points."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:30, :40]
    x, y = rng.uniform(0, 39, count), rng.uniform(0, 29, count)
    sampled = bilinear_at_pixels((2 * column + 3 * row).astype(np.float32), x, y)
    assert sampled.shape == (count,) and sampled.dtype == np.float32
    assert np.abs(sampled - (2 * x + 3 * y)).max(initial=0) < 0.1  # OpenCV quantises coordinates to 1/32 of a pixel


def test_points_outside_take_the_border_pixel() -> None:
    image = np.array([[10, 20], [30, 40]], np.uint8)
    x, y = np.array([[-5.0, 0.0, 9.0]]), np.array([[-5.0, 0.5, 9.0]])
    sampled = bilinear_at_pixels(image, x, y)
    assert sampled.dtype == np.uint8 and sampled.tolist() == [[10, 20, 40]]
