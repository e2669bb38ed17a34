"""The salient-object network finds a thing on a table, at the photo's aspect ratio, with any number of threads."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsbake.capture.masks.consensus import intersection_over_union
from gsbake.capture.masks.saliency import GUESS_SIZE, SaliencyNetwork
from gsbake.capture.masks.weights import WEIGHTS


@pytest.mark.skipif(not WEIGHTS.is_file(), reason="the weights are not installed")
def test_a_ball_on_a_table() -> None:
    height, width = 400, 600
    y, x = np.mgrid[:height, :width].astype(np.float32)
    photo = np.where((y > 180)[..., None], (150, 140, 130), (205, 205, 200)).astype(np.float32)
    dx, dy = (x - 330) / 110, (y - 210) / 110
    ball = dx**2 + dy**2 < 1
    shade = np.sqrt(np.clip(1 - dx**2 - dy**2, 0, 1)) * 0.7 + 0.3
    photo = np.where(ball[..., None], shade[..., None] * np.float32([200, 60, 40]), photo).astype(np.uint8)
    found = SaliencyNetwork(1).probability(photo)
    assert found.shape == (round(height * GUESS_SIZE / width), GUESS_SIZE) and found.dtype == np.uint8
    truth = cv2.resize(ball.astype(np.uint8), found.shape[::-1], interpolation=cv2.INTER_AREA) > 0
    assert intersection_over_union(found > 127, truth) > 0.9
    np.testing.assert_array_equal(SaliencyNetwork(2).probability(photo), found)
    assert SaliencyNetwork(1).probability(np.zeros((20, 30, 3), np.uint8)).shape == (20, 30)
