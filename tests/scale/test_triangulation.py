"""Points from pixel positions: exact ones are found exactly, and the covariance is that of many noisy trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsbake.capture.photos.undistortion import distort
from gsbake.geometry.cameras import Array, Camera
from gsbake.scale.triangulation import Ray, camera_rays, triangulate
from tests.support.cameras import look_at

POINT = np.array([0.2, -0.1, 0.3])
COEFFICIENTS = (-0.12, 0.03, 1e-3, -2e-3)


def views(distortion: tuple[float, ...] = ()) -> list[Camera]:
    eyes = [(3.0, 0.4, 1.0), (2.4, 1.9, 0.8), (1.0, 2.6, 1.4), (2.0, -2.0, 2.0)]
    return [replace(look_at(eye, size=(400, 300), focal=420.0, name=str(i)), distortion=distortion) for i, eye in enumerate(eyes)]


def seen(camera: Camera, point: Array) -> Array:
    local = camera.R @ point + camera.t
    plane = distort(local[:2] / local[2], camera.distortion or (0.0,))
    return np.array([camera.fx * plane[0] + camera.cx, camera.fy * plane[1] + camera.cy])


def rays(cameras: list[Camera], noise: Array | float = 0.0) -> list[Ray]:
    pixels = np.stack([seen(camera, POINT) for camera in cameras]) + noise
    return [camera_rays(camera, pixel[None])[0] for camera, pixel in zip(cameras, pixels, strict=True)]


@pytest.mark.parametrize("distortion", [(), COEFFICIENTS])
def test_an_exact_point_is_found(distortion: tuple[float, ...]) -> None:
    found = triangulate(rays(views(distortion)))
    assert found is not None
    assert np.allclose(found.position, POINT, atol=1e-9) and found.residuals.max() < 1e-5


def test_the_covariance_is_that_of_many_trials() -> None:
    rng, cameras = np.random.default_rng(0), views()
    positions, predicted = [], []
    for _ in range(400):
        found = triangulate(rays(cameras, rng.normal(0, 0.5, (4, 2))), noise=0.5)
        assert found is not None
        positions.append(found.position)
        predicted.append(np.trace(found.covariance))
    measured = np.trace(np.cov(np.stack(positions).T))
    assert 0.9 * measured < np.median(predicted) < 1.5 * measured  # residuals larger than the noise raise it


def test_rays_of_one_direction_determine_no_point() -> None:
    camera = look_at((3.0, 0.0, 0.0), name="a")
    nearby = look_at((3.0, 0.05, 0.0), name="b")
    assert triangulate(rays([camera, nearby])) is None
