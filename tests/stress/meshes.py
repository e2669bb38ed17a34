"""Hostile meshes by name: empty, single, degenerate, huge, tiny, far away, non-manifold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

Mesh = tuple[np.ndarray, np.ndarray]


def sphere(subdivisions: int = 3) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions, 0.7)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)


def mesh(vertices: object, faces: object) -> Mesh:
    return np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int32).reshape(-1, 3)


def scaled(factor: float, offset: float = 0.0) -> Mesh:
    vertices, faces = sphere()
    return vertices * factor + offset, faces


def needle() -> Mesh:
    vertices, faces = sphere()
    return vertices * [1, 1e-7, 1e-7], faces


def flat() -> Mesh:
    vertices, faces = sphere()
    return vertices * [1, 1, 0], faces


def collapsed() -> Mesh:
    vertices, faces = sphere()
    return np.full_like(vertices, 0.3), faces


def shuffled() -> Mesh:
    """Faces at random: non-manifold everywhere, crossing, partly with repeated corners."""
    rng = np.random.default_rng(1)
    return rng.uniform(-0.7, 0.7, (60, 3)), rng.integers(0, 60, (400, 3)).astype(np.int32)


def fan() -> Mesh:
    """Many faces on one edge, in both directions."""
    angle = np.linspace(0, 6, 12)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(12)], 1)
    faces = [[0, 1, 2 + k] if k % 2 else [1, 0, 2 + k] for k in range(12)]
    return mesh(np.concatenate([[[0, 0, -0.5], [0, 0, 0.5]], 0.5 * rim]), faces)


MESHES: dict[str, Callable[[], Mesh]] = {
    "empty": lambda: mesh([], []),
    "one triangle": lambda: mesh([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], [0, 1, 2]),
    "a point as triangle": lambda: mesh([[0.1, 0.1, 0.1]] * 3, [0, 1, 2]),
    "a segment as triangle": lambda: mesh([[0, 0, 0], [0.5, 0, 0], [0.2, 0, 0]], [0, 1, 2]),
    "two faces back to back": lambda: mesh([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], [[0, 1, 2], [0, 2, 1]]),
    "unused vertices": lambda: mesh([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [9, 9, 9]], [0, 1, 2]),
    "flat": flat,
    "collapsed to a point": collapsed,
    "needle": needle,
    "huge": lambda: scaled(1e6),
    "tiny": lambda: scaled(1e-6),
    "tiny and far away": lambda: scaled(1e-6, 1e3),
    "shuffled": shuffled,
    "fan": fan,
    "open": lambda: (sphere()[0], sphere()[1][::2].copy()),
    "inside out": lambda: (sphere()[0], sphere()[1][:, ::-1].copy()),
}
