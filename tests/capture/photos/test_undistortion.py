from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.photos.undistortion import distort, pinhole_camera, remap_tables, resample, undistort_points
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

LENSES = [
    (-0.2, 0.05, 0.0, 0.0),
    (0.15, -0.03, 0.002, -0.004),
    (0.1, 0.02, 0.001, 0.002, -0.01, 0.03, 0.01, 0.002),
]


def camera(k: tuple[float, ...]) -> Camera:
    return Camera("a", 320, 240, 260.0, 265.0, 155.0, 124.0, np.eye(3), np.zeros(3), k)


@pytest.mark.parametrize("k", LENSES)
def test_against_opencv(k: tuple[float, ...]) -> None:
    plane = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    cam = camera(k)
    pixels = cv2.projectPoints(np.c_[plane, np.ones(50)], np.zeros(3), np.zeros(3), cam.K, np.asarray(k))[0].reshape(-1, 2)
    distorted = distort(plane, k)
    assert distorted * (cam.fx, cam.fy) + (cam.cx, cam.cy) == pytest.approx(pixels, abs=1e-6)
    assert undistort_points(distorted, k) == pytest.approx(plane, abs=1e-6)


@pytest.mark.parametrize("k", LENSES)
def test_a_dot_is_resampled_to_its_pinhole_projection(k: tuple[float, ...]) -> None:
    source = camera(k)
    target = pinhole_camera(source)
    assert (target.fx, target.fy, target.distortion) == (source.fx, source.fy, ())
    points = np.array([[0.0, 0.0, 2.0], [0.7, 0.4, 2.0], [-0.8, -0.5, 2.0]])
    at = cv2.projectPoints(points, np.zeros(3), np.zeros(3), source.K, np.asarray(k))[0].reshape(-1, 2)
    wanted, _ = target.project(points)
    rows, columns = np.mgrid[:240, :320] + 0.5
    for (x, y), (u, v) in zip(at, wanted, strict=True):
        dot = 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
        photo = np.repeat(dot[..., None], 3, 2).astype(np.uint8)
        flat = resample(photo, remap_tables(source, target)).astype(float)[..., 0]
        grid_y, grid_x = np.mgrid[: target.height, : target.width] + 0.5
        assert (flat * grid_x).sum() / flat.sum() == pytest.approx(u, abs=0.1)
        assert (flat * grid_y).sum() / flat.sum() == pytest.approx(v, abs=0.1)


@pytest.mark.parametrize("k", LENSES)
def test_no_blank_pixels_and_minimal_cropping(k: tuple[float, ...]) -> None:
    source = camera(k)
    target = pinhole_camera(source)
    x, y = remap_tables(source, target)
    assert x.min() > -0.6 and y.min() > -0.6 and x.max() < 319.6 and y.max() < 239.6
    # The largest such rectangle touches each side of the photo.
    assert x.min() < 1.5 and y.min() < 1.5 and x.max() > 317.5 and y.max() > 237.5


def test_masks_stay_within_their_range() -> None:
    source = camera(LENSES[0])
    mask = np.zeros((240, 320), np.uint8)
    mask[60:180, 80:240] = 255
    tables = remap_tables(source, pinhole_camera(source))
    flat: np.ndarray[Any, Any] = resample(mask, tables, mask=True)
    assert flat.max() == 255 and flat.min() == 0 and flat[flat.shape[0] // 2, flat.shape[1] // 2] == 255


def test_distortion_that_is_not_invertible() -> None:
    with pytest.raises(BadInputError, match="cannot be inverted"):
        pinhole_camera(camera((-8.0, 0.0, 0.0, 0.0)))
    plain = pinhole_camera(camera((0.0, 0.0, 0.0, 0.0)))
    assert plain.distortion == () and (plain.width, plain.height, plain.cx) == (320, 240, 155.0)
