"""Whether a region holds some of a ball, by its masks: thin boxes do, those behind it in some photos do not."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.capture.hull.region import holds_object
from gsbake.geometry.region import Region
from tests.support.cameras import look_at


@pytest.mark.parametrize(
    ("centre", "size", "holds"),
    [
        ((0, 0, 0.3), (0.5, 0.5, 0.5), True),
        ((0.1, 0, 0.0), (4.0, 4.0, 0.004), True),
        ((0.0, 1.4, 0.0), (0.4, 0.4, 0.4), False),  # behind the ball as some cameras see it
        ((9, 9, 9), (1, 1, 1), False),
    ],
)
def test_it_holds_some_of_the_ball(centre: tuple[float, ...], size: tuple[float, ...], holds: bool) -> None:
    cameras = [look_at((3 * np.cos(a), 3 * np.sin(a), 0.5), size=120, focal=100, name=f"{a:.1f}") for a in np.arange(8) * np.pi / 4]
    masks = []
    for camera in cameras:
        ray = camera.rays()
        ray = ray / np.linalg.norm(ray, axis=2, keepdims=True)
        nearest = camera.centre - (ray @ camera.centre)[..., None] * ray
        masks.append((camera, (np.linalg.norm(nearest, axis=2) < 0.5).astype(np.uint8) * 255))
    assert holds_object(Region(np.array(centre, float), np.array(size, float), np.eye(3)), masks) is holds
