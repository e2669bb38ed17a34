"""Sampson distances of matches from the epipolar geometry of given cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.capture.colmap import pycolmap
from gsbake.capture.photos.undistortion import distort, image_plane
from gsbake.capture.sfm.epipolar import MIN_MATCHES, epipolar_error, sampson_distances
from gsbake.geometry.cameras import Array, Camera

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
LENS = (0.1, -0.05, 0.002, -0.001)


def camera(name: str, turn: tuple[float, float, float], t: tuple[float, float, float], lens: tuple[float, ...] = ()) -> Camera:
    rotation = np.asarray(cv2.Rodrigues(np.array(turn, float))[0], float)
    return Camera(name, 640, 480, 800.0, 800.0, 320.0, 240.0, rotation, np.array(t), lens)


def pixels(view: Camera, points: Array = POINTS) -> Array:
    plane = (view.project(points)[0] - (view.cx, view.cy)) / (view.fx, view.fy)
    return distort(plane, view.distortion or (0.0,) * 4) * (view.fx, view.fy) + (view.cx, view.cy)


def distances(a: Camera, b: Camera, points: Array, others: Array) -> Array:
    return sampson_distances(a, b, image_plane(a, points), image_plane(b, others))


def test_exact_matches_lie_on_the_lines_of_distorted_photos() -> None:
    a, b = camera("a", (0.1, 0.2, 0.0), (0.0, 0.1, 3.0), LENS), camera("b", (-0.2, 0.5, 0.3), (0.4, 0.0, 2.5), LENS)
    assert distances(a, b, pixels(a), pixels(b)) == pytest.approx(np.zeros(40), abs=1e-6)


def test_distance_across_the_rows_of_a_rectified_pair() -> None:
    """Epipolar lines are the rows; two photos share a shift of dy, so either point moves by dy / 2: dy / sqrt(2) in both together."""
    a, b = camera("a", (0, 0, 0), (0.0, 0.0, 3.0)), camera("b", (0, 0, 0), (-0.4, 0.0, 3.0))
    moved = pixels(b) + (5.0, 2.0)
    assert distances(a, b, pixels(a), moved) == pytest.approx(np.full(40, 2 / np.sqrt(2)))


@pytest.mark.parametrize(("count", "found"), [(MIN_MATCHES + 1, True), (MIN_MATCHES - 1, False)])
def test_error_of_a_database(tmp_path: Path, count: int, found: bool) -> None:
    """Two photos whose poses agree and one that is 2 px below where it is given: two of three pairs are off. Matches per photo: `count`."""
    a, b, c = (camera(name, (0, 0, 0), (x, 0.0, 3.0)) for name, x in (("a", 0.0), ("b", -0.4), ("c", -0.8)))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (count, 3))
    seen = [pixels(a, points), pixels(b, points), pixels(c, points) + (0.0, 2.0)]
    path = tmp_path / "database.db"
    base = pycolmap.Database.open(str(path))
    lens = base.write_camera(pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[800, 800, 320, 240]))
    ids = [base.write_image(pycolmap.Image(name=f"{name}.png", camera_id=lens)) for name in "abc"]
    for number, points_2d in zip(ids, seen, strict=True):
        base.write_keypoints(number, points_2d.astype(np.float32))
    matches = np.tile(np.arange(count, dtype=np.uint32)[:, None], (1, 2))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        geometry = pycolmap.TwoViewGeometry(inlier_matches=matches, config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
        base.write_two_view_geometry(ids[i], ids[j], geometry)
    base.close()
    error = epipolar_error(path, {view.name: view for view in (a, b, c)})
    assert error == pytest.approx(2 / np.sqrt(2), abs=1e-3) if found else error is None


def test_photos_without_features(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    base = pycolmap.Database.open(str(path))
    lens = base.write_camera(pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[800, 800, 320, 240]))
    for name in "ab":
        base.write_image(pycolmap.Image(name=f"{name}.png", camera_id=lens))
    base.close()
    assert epipolar_error(path, {name: camera(name, (0, 0, 0), (0.0, 0.0, 3.0)) for name in "ab"}) is None
