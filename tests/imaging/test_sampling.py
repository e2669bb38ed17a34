"""Reading a picture at places between its pixels."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.imaging.sampling import read_at


@pytest.mark.parametrize("count", [0, 1, 4096, 100_000])
def test_bilinear_at_any_number_of_places(count: int) -> None:
    """A picture that is a plane reads as that plane; OpenCV by itself refuses lists of more than 32 766 places."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:30, :40]
    x, y = rng.uniform(0, 39, count), rng.uniform(0, 29, count)
    read = read_at((2 * column + 3 * row).astype(np.float32), x, y)
    assert read.shape == (count,) and read.dtype == np.float32
    assert np.abs(read - (2 * x + 3 * y)).max(initial=0) < 0.1  # OpenCV keeps 1/32 of a pixel


def test_places_outside_show_the_border_and_shapes_stay() -> None:
    picture = np.array([[10, 20], [30, 40]], np.uint8)
    x, y = np.array([[-5.0, 0.0, 9.0]]), np.array([[-5.0, 0.5, 9.0]])
    read = read_at(picture, x, y)
    assert read.dtype == np.uint8 and read.tolist() == [[10, 20, 40]]
