"""The border of a mask is moved to where colours meet, unless they do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsbake.capture.masks.consensus import intersection_over_union
from gsbake.capture.masks.grab_cut import border_by_colour

SIZE = 300


def photo() -> tuple[np.ndarray, np.ndarray]:
    """A dark vase of two boxes and a disc before small coloured tiles, and its mask."""
    rng = np.random.default_rng(0)
    tiles = cv2.resize(rng.integers(130, 255, (60, 60, 3), np.uint8), (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[60:200, 120:180] = mask[200:240, 140:160] = 255
    cv2.ellipse(mask, (150, 245), (45, 12), 0, 0, 360, 255, -1)
    noise = rng.integers(0, 30, (SIZE, SIZE, 3), np.uint8)
    return np.where(mask[..., None] > 0, np.uint8([30, 50, 60]) + noise, tiles).astype(np.uint8), mask


@pytest.mark.parametrize("scale", [1, 3])
def test_a_rim_that_is_too_much_and_a_foot_that_is_missing(scale: int) -> None:
    rgb, true = (np.repeat(np.repeat(image, scale, 0), scale, 1) for image in photo())
    given = true.copy()
    given[255 * scale :] = 0  # the foot's lower edge
    given[54 * scale : 60 * scale, 125 * scale : 175 * scale] = 255
    before, after = (intersection_over_union(mask > 127, true > 127) for mask in (given, border_by_colour(rgb, given)))
    assert before < 0.965 and after > 0.985


def test_what_colours_do_not_distinguish_stays() -> None:
    _, mask = photo()
    grey = np.full((SIZE, SIZE, 3), 90, np.uint8)
    found = border_by_colour(grey, mask)
    assert 0.7 < (found > 0).sum() / (mask > 0).sum() < 1.4
    for given in (np.zeros((SIZE, SIZE), np.uint8), np.full((SIZE, SIZE), 255, np.uint8)):
        assert np.array_equal(border_by_colour(grey, given), given)
