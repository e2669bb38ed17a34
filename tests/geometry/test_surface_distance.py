"""Distances to a mesh, against closed forms and against all triangles one by one."""

from __future__ import annotations

import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gsbake.geometry.surface_distance import surface_distances


def test_distances_to_one_triangle() -> None:
    vertices, faces = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]], np.int32)
    points = np.array([[1.0, 1, 0.25], [1, 1, 0], [-3, 0, 4], [1, 1, -2], [4, 4, 1], [2, -3, 4]])
    np.testing.assert_allclose(surface_distances(points, vertices, faces), [0.25, 0, 5, 2, 3, 5], atol=1e-12)


def test_distances_to_a_sphere_near_and_far() -> None:
    sphere = trimesh.creation.icosphere(5)
    points = np.random.default_rng(0).normal(size=(500, 3)) * np.geomspace(0.1, 1e4, 500)[:, None]
    expected = np.abs(np.linalg.norm(points, axis=1) - 1)
    found = surface_distances(points, np.asarray(sphere.vertices), np.asarray(sphere.faces))
    np.testing.assert_allclose(found, expected, atol=1e-3)  # the sagitta of the faces


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([1e-6, 1.0, 1e6]))
def test_as_among_all_triangles(seed: int, count: int, scale: float) -> None:
    """Random triangles, some of them degenerate; the smallest distance by sampling is never smaller, and at most a little larger."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(3 * count, 3)) * scale
    faces = np.arange(3 * count).reshape(-1, 3)
    vertices[faces[::5, 2]] = vertices[faces[::5, 1]]  # segments
    vertices[faces[::7, 1:]] = vertices[faces[::7, :1]]  # points
    points = rng.normal(size=(8, 3)) * 2 * scale
    found = surface_distances(points, vertices, faces)
    steps = np.linspace(0, 1, 41)
    a, b = (g.ravel() for g in np.meshgrid(steps, steps))
    a, b = a[a + b <= 1 + 1e-9], b[a + b <= 1 + 1e-9]
    samples = vertices[faces] @ np.eye(3)
    samples = (1 - a - b)[:, None] * samples[:, None, 0] + a[:, None] * samples[:, None, 1] + b[:, None] * samples[:, None, 2]
    sampled = np.linalg.norm(points[:, None, None] - samples, axis=3).min((1, 2))
    assert (found <= sampled + 1e-9 * scale).all() and (found >= sampled - 0.15 * scale).all()


def test_no_points_and_no_faces() -> None:
    assert surface_distances(np.zeros((0, 3)), np.eye(3), np.array([[0, 1, 2]])).shape == (0,)
    assert np.isinf(surface_distances(np.zeros((2, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int32))).all()
