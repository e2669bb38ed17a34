"""Look-at cameras of the tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsbake.geometry.cameras import Camera

Array = NDArray[np.float64]
ORIGIN, Z_UP = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def look_at_rotation(eye: ArrayLike, target: ArrayLike = ORIGIN, up: ArrayLike = Z_UP) -> Array:
    """Rotation (3, 3) world→camera, OpenCV axes, of a camera at `eye` (3,) that looks at `target` (3,); `up` (3,) is vertical in it."""
    forward = np.asarray(target, float) - np.asarray(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, float))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def look_at(
    eye: ArrayLike,
    target: ArrayLike = ORIGIN,
    *,
    size: int | tuple[int, int] = 160,
    focal: float = 200.0,
    name: str = "camera",
    up: ArrayLike = Z_UP,
    roll: float = 0.0,
    shift: Sequence[float] = (0.0, 0.0),
) -> Camera:
    """Pinhole camera at `eye` (3,) that looks at `target` (3,): `size` (width, height) or the edge of a square, `focal` in pixels,
    rotated by `roll` radians around the optical axis, principal point off the image centre by `shift` pixels."""
    width, height = (size, size) if isinstance(size, int) else size
    rotation = look_at_rotation(eye, target, up)
    if roll:
        rotation = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]) @ rotation
    principal = width / 2 + shift[0], height / 2 + shift[1]
    return Camera(name, width, height, focal, focal, *principal, rotation, -rotation @ np.asarray(eye, float))
