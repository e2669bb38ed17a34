"""Errors of stereo's points against ground truth: points beside a plane, with normals that are tilted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import stereo
from benchmarks.stereo import point_errors
from benchmarks.truth import Surface, Truth
from gsbake.geometry.cameras import CameraSet
from gsbake.mvs.point_cloud import StereoCloud
from tests.support.cameras import look_at


def test_points_off_a_square(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A square with a diagonal of √8; half of the points .02 above it with a normal that is tilted by 10°."""
    square = Surface(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    monkeypatch.setattr(stereo, "read_truth", lambda capture: Truth(square, {}))
    (tmp_path / "photos").mkdir()
    CameraSet((look_at((0, 0.1, 3), size=32, focal=40.0, name="a"),)).save(tmp_path / "cameras.json")
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 10), np.linspace(-0.9, 0.9, 10))
    off = (x > 0).ravel()
    points = np.stack([x.ravel(), y.ravel(), 0.02 * off], 1)
    tilt = np.radians(10) * off
    normals = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], 1)
    n = len(points)
    StereoCloud(points, normals, np.zeros((n, 3), np.uint8), np.ones(n), np.ones(n), np.full(n, 3, np.uint8)).save(tmp_path / "points.ply")
    distance, angle = point_errors(tmp_path, tmp_path, tmp_path)
    assert distance[off] == pytest.approx(100 * 0.02 / np.sqrt(8), rel=1e-3) and distance[~off] == pytest.approx(0, abs=1e-6)
    assert angle[off] == pytest.approx(10, abs=0.05) and angle[~off] == pytest.approx(0, abs=0.05)
