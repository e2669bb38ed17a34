"""Bilateral normal filtering on shapes whose normals are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing.refinement.normal_filter import denoise, face_normals, filter_normals, neighbours_across_edges


def sphere(noise: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(5, 1.0)
    ripple = np.random.default_rng(0).normal(0, noise, len(mesh.vertices))
    return np.asarray(mesh.vertices) * (1 + ripple[:, None]), np.asarray(mesh.faces, np.int32)


def box(noise: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box((1, 1, 1))
    for _ in range(5):
        mesh = mesh.subdivide()
    vertices = np.asarray(mesh.vertices)
    return vertices + np.random.default_rng(0).normal(0, noise, vertices.shape), np.asarray(mesh.faces, np.int32)


def angles(normal: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((normal * true).sum(1), -1, 1)))


def test_ripple_of_a_sphere_is_removed_without_shrinking_it() -> None:
    vertices, faces = sphere(0.001)
    smooth = denoise(vertices, faces, 20)
    true = face_normals(*sphere(0.0))[0]
    before, after = (angles(face_normals(v, faces)[0], true).mean() for v in (vertices, smooth))
    assert before > 1.5
    assert after < 0.4 * before
    radius = np.linalg.norm(smooth, axis=1)
    assert radius.mean() == pytest.approx(1, abs=2e-4)
    assert radius.std() < 0.7e-3


def test_edges_of_a_box_stay() -> None:
    vertices, faces = box(0.0005)
    smooth = denoise(vertices, faces, 20)
    true = face_normals(*box(0.0))[0]
    before, after = (angles(face_normals(v, faces)[0], true) for v in (vertices, smooth))
    assert after.mean() < 0.4 * before.mean()
    corners = np.abs(box(0.0)[0]).min(1) > 0.499
    assert corners.sum() == 8
    assert np.linalg.norm(smooth[corners] - box(0.0)[0][corners], axis=1).max() < 0.003
    assert trimesh.Trimesh(smooth, faces, process=False).volume == pytest.approx(1, abs=1e-3)


def test_exact_shapes_and_no_iterations_change_nothing() -> None:
    vertices, faces = box(0.0)
    np.testing.assert_allclose(denoise(vertices, faces, 20), vertices, atol=1e-12)
    rough = sphere(0.01)[0]
    assert denoise(rough, sphere(0.0)[1], 0) is rough


def test_neighbours_are_those_of_trimesh() -> None:
    vertices, faces = sphere(0.0)
    found = neighbours_across_edges(vertices, faces)
    expected = {tuple(sorted(pair)) for pair in trimesh.Trimesh(vertices, faces, process=False).face_adjacency.tolist()}
    assert {tuple(sorted((face, int(other)))) for face, row in enumerate(found) for other in row} == expected


def test_borders_faces_without_area_and_non_manifold_edges() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0.5, 0, 0]], float)
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 5, 1]], np.int32)
    assert (neighbours_across_edges(vertices, faces) == -1).all()
    normal = filter_normals(vertices, faces, 3)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), [1, 1, 1, 0])
    assert np.isfinite(denoise(vertices, faces, 3)).all()
    assert len(denoise(np.zeros((0, 3)), np.zeros((0, 3), np.int32), 3)) == 0


def test_mean_by_hand() -> None:
    """Two triangles of equal area, 4° apart: their normals move to 4° · (1 − 2 w / (1 + w)) to first order, w = exp(−(2 sin 2°)² / 2σ²)."""
    angle = np.radians(4)
    vertices = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [-np.cos(angle), 0, np.sin(angle)]])
    faces = np.array([[0, 2, 1], [0, 1, 3]], np.int32)
    before, after = face_normals(vertices, faces)[0], filter_normals(vertices, faces, 1)
    weight = np.exp(-0.5 * (2 * np.sin(angle / 2) / np.radians(8)) ** 2)
    assert angles(before[:1], before[1:])[0] == pytest.approx(4)
    assert angles(after[:1], after[1:])[0] == pytest.approx(4 * (1 - weight) / (1 + weight), rel=1e-3)
