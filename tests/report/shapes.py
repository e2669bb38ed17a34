"""Small analytic textured meshes."""

from __future__ import annotations

import numpy as np

from gsbake.geometry.cameras import Camera
from gsbake.report.render import Asset


def quad(base: np.ndarray, **more: object) -> Asset:
    """Square of edge 2 in the plane z = 0 facing +Z, texture upright as seen from +Z with +Y up."""
    position = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (4, 1))
    tangent = np.tile(np.float32([1, 0, 0, 1]), (4, 1))
    faces = np.array([[0, 3, 2], [0, 2, 1]], np.int32)
    return Asset(position, normal, tangent, uv, faces, base.astype(np.float32), **more)  # type: ignore[arg-type]


def ball(radius: float = 1.0, rows: int = 96, grey: float = 0.5, **more: object) -> Asset:
    """UV sphere about the origin with smooth normals."""
    theta, phi = np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    normal = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], -1).reshape(-1, 3)
    uv = np.stack([p / (2 * np.pi), t / np.pi], -1).reshape(-1, 2)
    wide = 2 * rows + 1
    first = (np.arange(rows)[:, None] * wide + np.arange(2 * rows)[None]).ravel()
    faces = np.concatenate([np.stack([first, first + wide, first + wide + 1], 1), np.stack([first, first + wide + 1, first + 1], 1)])
    base = np.full((4, 4, 3), grey, np.float32)
    return Asset(radius * normal, normal.astype(np.float32), None, uv.astype(np.float32), faces.astype(np.int32), base, **more)  # type: ignore[arg-type]


def front_camera(distance: float, size: int, focal: float, name: str = "front") -> Camera:
    """Camera on +Z looking along −Z with +Y up in the image."""
    rotation = np.diag([1.0, -1.0, -1.0])
    return Camera(name, size, size, focal, focal, size / 2, size / 2, rotation, -rotation @ np.array([0, 0, distance]))
