"""Clean-up of meshes with known results."""

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
