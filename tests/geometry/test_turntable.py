"""Cameras of turntables and from hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsbake.geometry.cameras import Camera, Similarity
from gsbake.geometry.turntable import turntable_share
from tests.support.cameras import look_at


def camera(centre: np.ndarray, noise: float = 0.0, seed: int = 0) -> Camera:
    """A level camera at `centre` that looks at the origin, turned by a `noise` in radians."""
    level = look_at(centre)
    turned = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, noise, 3)).as_matrix()
    return replace(level, R=turned @ level.R, t=turned @ level.t)


def around(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    return distance * np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


def test_rounds_of_a_camera_that_was_moved_between_them_are_found() -> None:
    rng = np.random.default_rng(1)
    places = [around(a, 0.3 + 0.4 * k, 3 + 0.2 * k) for k in range(2) for a in np.arange(12) * 0.52]
    cameras = [camera(p + rng.normal(0, 0.002, 3), 0.001, k) for k, p in enumerate(places)]
    assert turntable_share(cameras) == 1
    tilted = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()  # the frame is free
    frame = Similarity(0.4, tilted, np.array([2.0, -1.0, 5.0]))
    assert turntable_share([c.moved(frame) for c in cameras]) == 1


def test_cameras_from_hand_on_a_spiral_or_anywhere_are_on_no_circles() -> None:
    rng = np.random.default_rng(2)
    hand = [around(a, 0.4 + rng.normal(0, 0.06), 3 + rng.normal(0, 0.15)) for a in np.arange(36) * 0.17]
    assert turntable_share([camera(p, 0.05, k) for k, p in enumerate(hand)]) < 0.3
    spiral = [around(0.5 * k, 0.1 + 0.03 * k, 3) for k in range(36)]
    assert turntable_share([camera(p) for p in spiral]) < 0.3
    anywhere = [around(rng.uniform(0, 6), np.arcsin(rng.uniform(-0.4, 0.95)), 3) for _ in range(36)]
    assert turntable_share([camera(p) for p in anywhere]) < 0.3


def test_few_cameras_are_no_turntable() -> None:
    assert turntable_share([]) == 0
    assert turntable_share([camera(around(0.3 * k, 0.3, 3)) for k in range(3)]) == 0
