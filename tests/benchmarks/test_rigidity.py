"""Groups of photos of one object, and of one whose lid moved between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import rigidity
from gsbake.geometry.cameras import Camera
from gsbake.synth.capture import look_at


def silhouette(camera: Camera, ball: tuple[float, float, float]) -> np.ndarray:
    """A ball in the middle and a smaller one."""
    rays = camera.rays()
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    inside = np.zeros(rays.shape[:-1], bool)
    for centre, radius in (((0.0, 0.0, 0.0), 0.4), (ball, 0.2)):
        to = np.array(centre) - camera.centre
        along = rays @ to
        inside |= np.linalg.norm(to - along[..., None] * rays, axis=-1) < radius
    return np.where(inside, 255, 0).astype(np.uint8)


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    """Two rounds of eight cameras around the object, from two heights."""
    around = [(np.deg2rad(45 * k), height) for height in (0.4, 1.6) for k in range(8)]
    places = [np.array([3 * np.cos(a), 3 * np.sin(a), z]) for a, z in around]
    return [look_at(f"{k:02d}", place, np.zeros(3), 0.0, 300.0, (80.0, 80.0), 160) for k, place in enumerate(places)]


def test_a_part_that_moved_is_left_out_by_the_hull_of_all(cameras: list[Camera]) -> None:
    still, moved, every = (0.5, 0.0, 0.2), (0.0, 0.5, 0.2), range(16)
    rigid = [silhouette(camera, still) for camera in cameras]
    assert rigidity.left_out(cameras, rigid, every, every).max() < 0.01
    turned = rigid[:8] + [silhouette(camera, moved) for camera in cameras[8:]]
    for group in (range(8), range(8, 16)):
        assert rigidity.left_out(cameras, turned, group, group).max() < 0.01
    assert np.median(rigidity.left_out(cameras, turned, every, every)) > 0.05
    lines = rigidity.table(cameras, turned, 2).splitlines()
    assert len(lines) == 4 and lines[2].startswith("| 00 to 07 | 0.") and lines[3].startswith("| 08 to 15 | 0.")


def test_runs_that_cannot_be_measured_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rigidity.main([str(tmp_path)]) != 0
    assert "no finished stage poses" in capsys.readouterr().err
