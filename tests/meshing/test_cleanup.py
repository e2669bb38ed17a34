"""Clean-up and decimation of meshes with known results."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing import cleanup as clean


def sphere(subdivisions: int = 4, radius: float = 1.0, centre: tuple = (0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces, np.int32)


def concatenate_meshes(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    offset, vertices, faces = 0, [], []
    for v, f in parts:
        vertices.append(v)
        faces.append(f + offset)
        offset += len(v)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def test_topology_counts() -> None:
    vertices, faces = concatenate_meshes(sphere(2), sphere(2, centre=(3, 0, 0)))
    assert clean.topology(vertices, faces) == clean.Topology(2, True, 0, 0)
    assert clean.topology(vertices, faces[1:]) == clean.Topology(2, False, 3, 0)
    assert clean.topology(vertices, np.concatenate([faces, faces[:1]])).non_manifold_edges == 3
    assert clean.topology(np.zeros((0, 3)), np.zeros((0, 3), np.int32)).components == 0


def test_small_components_and_cavities_are_removed() -> None:
    inner = sphere(2, 0.5)
    vertices, faces = concatenate_meshes(sphere(), (inner[0], inner[1][:, ::-1]), sphere(1, 0.05, (2, 0, 0)), sphere(3, 0.4, (3, 0, 0)))
    kept_vertices, kept, removed = clean.remove_small_components(vertices, faces, 0.02)
    assert removed == 2
    assert clean.topology(kept_vertices, kept).components == 2
    assert trimesh.Trimesh(kept_vertices, kept, process=False).volume == pytest.approx(4 / 3 * np.pi * (1 + 0.4**3), rel=0.02)
    assert clean.remove_small_components(kept_vertices, kept, 0.02)[2] == 0


def test_smoothing_removes_noise_and_keeps_volume() -> None:
    vertices, faces = sphere(5)
    noisy = vertices * (1 + 0.01 * np.random.default_rng(0).normal(size=(len(vertices), 1)))
    out = clean.smooth(noisy, faces, 10)
    before, after = (np.abs(np.linalg.norm(v, axis=1) - 1).mean() for v in (noisy, out))
    assert after < 0.45 * before
    assert trimesh.Trimesh(out, faces, process=False).volume == pytest.approx(4 / 3 * np.pi, rel=0.003)


def test_smoothing_keeps_boundaries() -> None:
    mesh = trimesh.creation.box()
    vertices, faces = np.asarray(mesh.subdivide().subdivide().vertices), np.asarray(mesh.subdivide().subdivide().faces, np.int32)
    faces = faces[vertices[faces].mean(1)[:, 2] < 0.4999]  # open at the top
    vertices, faces = clean.remove_unused_vertices(vertices, faces)
    boundary = np.isclose(vertices[:, 2], 0.5)
    assert boundary.sum() > 4
    np.testing.assert_array_equal(clean.smooth(vertices, faces, 5)[boundary], vertices[boundary])


def test_holes_are_closed_up_to_a_maximum_size() -> None:
    vertices, faces = sphere(3)
    centre = vertices[faces].mean(1)
    small = faces[np.linalg.norm(centre - [0, 0, 1], axis=1) > 0.2]
    closed = clean.close_holes(vertices, small, 60)
    assert clean.topology(*closed).watertight
    assert trimesh.Trimesh(*closed, process=False).is_winding_consistent
    remaining = clean.close_holes(vertices, faces[centre[:, 2] < 0.3], 20)
    assert clean.topology(*remaining).border_edges > 20


def test_repair_removes_non_manifold_faces() -> None:
    vertices, faces = sphere(2)
    extra = np.array([[faces[0, 0], faces[0, 1], len(vertices)], [0, 0, 1], faces[3]], np.int32)
    fixed = clean.repair(np.concatenate([vertices, [[2.0, 0, 0]]]), np.concatenate([faces, extra]))
    found = clean.topology(*fixed)
    assert found.non_manifold_edges == 0


def test_surface_distances_are_to_the_triangles() -> None:
    vertices, faces = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]], np.int32)
    points = np.array([[1.0, 1, 0.25], [1, 1, 0], [-3, 0, 4], [1, 1, -2]])
    np.testing.assert_allclose(clean.surface_distances(points, vertices, faces), [0.25, 0, 5, 2], atol=1e-9)
