"""A textured sphere or plane with known cameras: exact depths and photos by ray casting, independent of the code under test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.mvs.pyramids import Photo, image_pyramid
from tests.support.cameras import look_at

Array = NDArray[np.float64]
RADIUS = 0.7


def camera_at(eye: Array, name: str, width: int = 220, height: int = 190) -> Camera:
    """A camera facing the origin, z up, with an off-centre principal point."""
    return look_at(eye, size=(width, height), focal=width * 1.5, name=name, shift=(2.3, -1.7))


def arc(count: int = 5, step: float = 11.0, **size: int) -> list[Camera]:
    """Cameras on an arc of a circle of radius 3, `step` degrees apart, at varying height."""
    out = []
    for i in range(count):
        a, e = np.radians(step * (i - count // 2)), np.radians(8.0 * (i % 2) + 5)
        out.append(camera_at(3 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]), f"{i:02d}", **size))
    return out


def texture(points: Array) -> Array:
    """Solid texture (grey, 0..255): waves in many directions, wavelengths from about 8 pixels."""
    rng = np.random.default_rng(3)
    total = np.zeros(points.shape[:-1])
    for scale in (15, 30, 50, 75):
        for _ in range(4):
            direction = rng.normal(size=3)
            total += np.sin(points @ (direction * scale / np.linalg.norm(direction)) + rng.uniform(0, 6))
    return np.clip(128 + 18 * total, 0, 255)


def sphere_depth(camera: Camera) -> Array:
    """z-depth (h, w) of the sphere around the origin, 0 = none."""
    rays = camera.rays()
    a, b = (rays**2).sum(-1), rays @ camera.centre
    root = b * b - a * (camera.centre @ camera.centre - RADIUS**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)


def plane_depth(camera: Camera) -> Array:
    """z-depth (h, w) of the slanted plane x + .3 y − .2 z = .2."""
    normal = np.array([1, 0.3, -0.2])
    return np.maximum((0.2 - camera.centre @ normal) / (camera.rays() @ normal), 0)


def photo(camera: Camera, depth: Array, flat: bool = False) -> Photo:
    """The camera's photo of a surface at `depth` (h, w); uniform grey when `flat`."""
    points = camera.centre + depth[..., None] * camera.rays()
    grey = np.where(depth > 0, 128.0 if flat else texture(points), 0)
    return Photo(camera, grey.round().astype(np.uint8), (depth > 0).astype(np.uint8))


def sphere_photos(cameras: list[Camera], flat: bool = False) -> list[list[Photo]]:
    """Image pyramids of the sphere."""
    return [image_pyramid(photo(c, sphere_depth(c), flat)) for c in cameras]
