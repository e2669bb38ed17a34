"""Analytic shapes and cameras: depth maps by sphere tracing, independent of the code under test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from tests.support.cameras import look_at

Array = NDArray[np.float64]
Shape = Callable[[Array], Array]


def sphere(p: Array) -> Array:
    return np.linalg.norm(p, axis=-1) - 0.6


def torus(p: Array) -> Array:
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 0.55, p[..., 2]) - 0.22


def box_with_rod(p: Array) -> Array:
    q = np.abs(p - np.array([0, 0, -0.2])) - np.array([0.45, 0.3, 0.25])
    box = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    along = np.clip(p[..., 2], 0, 0.7)
    rod = np.sqrt((p[..., 0] - 0.1) ** 2 + p[..., 1] ** 2 + (p[..., 2] - along) ** 2) - 0.03
    return np.minimum(box, rod)


def cylinder(p: Array) -> Array:
    q = np.stack([np.hypot(p[..., 0], p[..., 1]) - 0.45, np.abs(p[..., 2]) - 0.45], -1)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def camera_at(eye: Array, name: str, size: int = 160) -> Camera:
    """A camera at `eye` that looks at the origin, z up."""
    # The principal point is off the middle on purpose.
    return look_at(eye, size=(size, size - 10), focal=size * 1.2, name=name, shift=(1.3, -1.7))


def cameras_around(elevations: tuple[float, ...] = (-35, 10, 50), each: int = 6, size: int = 160) -> list[Camera]:
    """Rings of cameras at a distance of 3."""
    out = []
    for ring, elevation in enumerate(np.radians(elevations)):
        for i in range(each):
            a = 2 * np.pi * (i + ring / 3) / each
            eye = 3 * np.array([np.cos(a) * np.cos(elevation), np.sin(a) * np.cos(elevation), np.sin(elevation)])
            out.append(camera_at(eye, f"{ring}-{i}", size))
    return out


def gradient(shape: Shape, points: Array) -> Array:
    """Unit outward normals (…, 3) by central differences."""
    step = 1e-5
    out = np.stack([shape(points + step * e) - shape(points - step * e) for e in np.eye(3)], -1)
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)


def trace(shape: Shape, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """z-depth (h, w; 0 = none), unit normals (h, w, 3) and |cosine| (h, w) through the pixel centres."""
    rays = camera.rays()
    slant = np.linalg.norm(rays, axis=-1)
    z = np.full(slant.shape, 1.0)
    on = np.ones(slant.shape, bool)  # rays that still move
    for _ in range(120):
        step = 0.95 * shape(camera.centre + z[on][:, None] * rays[on]) / slant[on]
        z[on] = np.minimum(z[on] + step, 20)
        on[on] = (np.abs(step) > 1e-12) & (z[on] < 20)
    points = camera.centre + z[..., None] * rays
    hit = np.abs(shape(points)) < 1e-3
    normal = gradient(shape, points) * hit[..., None]
    cosine = np.abs((normal * rays).sum(-1)) / slant
    return np.where(hit, z, 0).astype(np.float32), normal.astype(np.float32), cosine.astype(np.float32)
