"""Cameras of turntables and from hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsbake.geometry.cameras import Camera, Similarity
from gsbake.geometry.turntable import find_turntable
from tests.support.cameras import look_at


def camera(centre: np.ndarray, noise: float = 0.0, seed: int = 0) -> Camera:
    """A level camera at `centre` that looks at the origin, turned by a `noise` in radians."""
    level = look_at(centre)
    turned = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, noise, 3)).as_matrix()
    return replace(level, R=turned @ level.R, t=turned @ level.t)


def around(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    return distance * np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


def share(cameras: list[Camera]) -> float:
    found = find_turntable(cameras)
    return 0.0 if found is None else found.share


def test_rounds_of_a_camera_that_was_moved_between_them_are_found() -> None:
    rng = np.random.default_rng(1)
    places = [around(a, 0.3 + 0.4 * k, 3 + 0.2 * k) for k in range(2) for a in np.arange(12) * 0.52]
    cameras = [camera(p + rng.normal(0, 0.002, 3), 0.001, k) for k, p in enumerate(places)]
    assert share(cameras) == 1
    tilted = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()  # the frame is free
    frame = Similarity(0.4, tilted, np.array([2.0, -1.0, 5.0]))
    assert share([c.moved(frame) for c in cameras]) == 1


def test_an_object_that_was_laid_down_differently_is_in_the_same_room() -> None:
    """Twelve photos of one position and nine of the other, whose poses are less exact; one is from another height."""
    rng = np.random.default_rng(4)
    laid = Similarity(1.0, Rotation.from_rotvec([1.4, 0.3, -0.5]).as_matrix(), np.array([0.3, -0.2, 0.1]))
    first = [camera(around(a, 0.5, 3)) for a in np.arange(12) * 0.52]
    second = [camera(around(a, 0.5, 3) + rng.normal(0, 0.01, 3), 0.004, k).moved(laid) for k, a in enumerate(np.arange(8) * 0.75)]
    second.append(camera(around(6.1, 0.65, 3)).moved(laid))
    found = find_turntable(first + second)
    assert found is not None and found.counts == [12, 9] and found.on_circle.tolist() == [True] * 20 + [False]
    up = np.array([0.0, 0.0, 1.0])
    assert np.allclose(found.axes, [up, laid.rotation @ up], atol=0.02)
    to_room = found.to_room(first + second)
    lamp = around(0.9, 0.4, 1)  # in the room, where the camera is at azimuth 0
    for k, rotation in enumerate(to_room):
        azimuth = [*np.arange(12) * 0.52, *np.arange(8) * 0.75, 6.1][k]
        by_object = around(0.9 + azimuth, 0.4, 1) @ (np.eye(3) if k < 12 else laid.rotation.T)
        assert rotation @ by_object == pytest.approx(lamp, abs=0.03)


def test_cameras_from_hand_on_a_spiral_or_anywhere_are_on_no_circles() -> None:
    rng = np.random.default_rng(2)
    hand = [around(a, 0.4 + rng.normal(0, 0.06), 3 + rng.normal(0, 0.15)) for a in np.arange(36) * 0.17]
    assert share([camera(p, 0.05, k) for k, p in enumerate(hand)]) < 0.3
    spiral = [around(0.5 * k, 0.1 + 0.03 * k, 3) for k in range(36)]
    assert share([camera(p) for p in spiral]) < 0.3
    anywhere = [around(rng.uniform(0, 6), np.arcsin(rng.uniform(-0.4, 0.95)), 3) for _ in range(36)]
    assert share([camera(p) for p in anywhere]) < 0.3


def test_few_cameras_are_no_turntable() -> None:
    assert find_turntable([]) is None
    assert find_turntable([camera(around(0.3 * k, 0.3, 3)) for k in range(3)]) is None


def test_a_part_of_a_turn_is_none() -> None:
    """Photos of one height from hand, from one side."""
    assert share([camera(around(0.2 * k, 0.3, 3)) for k in range(7)]) == 0
    assert share([camera(around(0.3 * k, 0.3, 3)) for k in range(7)]) == 1
