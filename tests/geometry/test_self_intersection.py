"""Faces that cross each other: by hand, and against all pairs of random triangles solved one by one."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.geometry.self_intersection import self_intersecting_faces


def crossing_pairs(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which faces cross another one, by solving for each edge and each face that share no corner."""
    found = np.zeros(len(faces), bool)
    for i, face in enumerate(faces):
        for a, b in zip(face, np.roll(face, -1), strict=True):
            for j, other in enumerate(faces):
                if i != j and not {a, b} & set(other):
                    p, q, r = vertices[other]
                    s, t, u = np.linalg.solve(np.stack([q - p, r - p, vertices[a] - vertices[b]], 1), vertices[a] - p)
                    found[[i, j]] |= s > 0 and t > 0 and s + t < 1 and 0 < u < 1
    return found


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e4])
def test_random_triangles(scale: float) -> None:
    """Some of them share corners."""
    rng = np.random.default_rng(1)
    vertices = rng.normal(size=(40, 3))
    faces = np.stack([rng.choice(40, 3, replace=False) for _ in range(14)])
    expected = crossing_pairs(vertices, faces)
    assert 0 < expected.sum() < len(faces)
    np.testing.assert_array_equal(self_intersecting_faces(scale * vertices, faces), expected)


def test_a_closed_surface_does_not_cross_itself_and_two_of_them_do() -> None:
    sphere = trimesh.creation.icosphere(4)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    assert not self_intersecting_faces(vertices, faces).any()
    shift = np.array([0.7, 0.013, 0.021])
    both, all_faces = np.concatenate([vertices, vertices + shift]), np.concatenate([faces, faces + len(vertices)])
    found = self_intersecting_faces(both, all_faces)
    middle = both[all_faces].mean(1)
    on_both = np.abs(np.linalg.norm(middle, axis=1) - np.linalg.norm(middle - shift, axis=1))
    assert found.any() and on_both[found].max() < 0.1  # a ring in the plane of both, of the width of a face
    first = np.arange(len(all_faces)) < len(faces)
    np.testing.assert_array_equal(self_intersecting_faces(both, all_faces, first), found)
    np.testing.assert_array_equal(self_intersecting_faces(both, all_faces, found & first), found)


def test_no_faces() -> None:
    assert len(self_intersecting_faces(np.zeros((0, 3)), np.zeros((0, 3), np.int32))) == 0
    assert not self_intersecting_faces(np.eye(3), np.array([[0, 1, 2]]), np.zeros(1, bool)).any()
