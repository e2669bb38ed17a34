"""MikkTSpace tangents against closed forms and the reference implementation."""

from __future__ import annotations

import numpy as np
import trimesh

from benchmarks.tangents import reference
from gsbake.geometry.tangents import frame_to_world, tangents, world_to_frame
from gsbake.texturing.normal_map import vertex_normals


def patch(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Grid parameters (v, 2) in 0..1 and triangles with positive winding in (s, t)."""
    s, t = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="xy")
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel(), k[1:, :-1].ravel()
    return np.stack([s.ravel(), t.ravel()], 1), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_plane_with_upright_image() -> None:
    """A wall in the x-z plane facing -y, u along +x, image up along +z."""
    grid, faces = patch()
    position = np.column_stack([grid[:, 0], np.zeros(len(grid)), grid[:, 1]])
    normal = np.tile([0.0, -1, 0], (len(grid), 1))
    found = tangents(position, normal, np.column_stack([grid[:, 0], 1 - grid[:, 1]]), faces)
    assert np.allclose(found.tangent, [1, 0, 0, 1], atol=1e-6)
    # A normal tilted up in the image (green above one half) tilts towards +z.
    assert np.allclose(frame_to_world([[0, 0.6, 0.8]], normal[:1], found.tangent[:1]), [[0, -0.8, 0.6]], atol=1e-6)
    assert np.array_equal(found.faces, faces)


def test_sphere_in_longitude_and_latitude() -> None:
    grid, faces = patch(40)
    lon, lat = 2.0 * grid[:, 0], 2.0 * grid[:, 1] - 1
    normal = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], 1)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], 1)
    found = tangents(3 * normal, normal, np.column_stack([grid[:, 0], 1 - grid[:, 1]]), faces)
    inner = (np.abs(grid - 0.5) < 0.49).all(1)
    angle = np.degrees(np.arccos(np.clip((found.tangent[:, :3] * east).sum(1), -1, 1)))
    assert angle[inner].max() < 0.2 and (found.tangent[:, 3] == 1).all()
    assert np.abs((found.tangent[:, :3] * normal).sum(1)).max() < 1e-6


def test_mirrored_uvs_are_split_with_opposite_sign() -> None:
    grid, faces = patch(9)
    position = np.column_stack([grid[:, 0] - 0.5, grid[:, 1], np.zeros(len(grid))])
    normal = np.tile([0.0, 0, 1], (len(grid), 1))
    found = tangents(position, normal, np.column_stack([np.abs(position[:, 0]), 1 - grid[:, 1]]), faces)
    assert len(found.source) == len(grid) + 9
    left = position[faces].mean(1)[:, 0] < 0
    assert np.array_equal(found.source[found.faces], faces)
    assert np.allclose(found.tangent[found.faces[left].ravel()], [-1, 0, 0, -1], atol=1e-6)
    assert np.allclose(found.tangent[found.faces[~left].ravel()], [1, 0, 0, 1], atol=1e-6)


def test_degenerate_uvs_give_a_frame() -> None:
    grid, faces = patch(4)
    normal = np.tile([0.0, 0, 1], (len(grid), 1))
    found = tangents(np.column_stack([grid, np.zeros(len(grid))]), normal, np.zeros((len(grid), 2)), faces)
    assert np.allclose(np.linalg.norm(found.tangent[:, :3], axis=1), 1) and np.abs(found.tangent[:, 2]).max() < 1e-6


def test_frame_transforms_are_inverse() -> None:
    rng = np.random.default_rng(0)
    vector = rng.normal(size=(50, 3))
    normal = rng.normal(size=(50, 3))
    tangent = np.column_stack([rng.normal(size=(50, 3)), rng.choice([-1.0, 1.0], 50)])
    back = frame_to_world(world_to_frame(vector, normal, tangent), normal, tangent)
    assert np.allclose(back, vector / np.linalg.norm(vector, axis=1, keepdims=True), atol=1e-9)


def test_equals_the_reference_implementation() -> None:
    """Against mikktspace.c compiled to WebAssembly (npm package `mikktspace`)."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    rng = np.random.default_rng(0)
    position, faces = np.asarray(ball.vertices) * (1 + 0.1 * rng.random((len(ball.vertices), 1))), np.asarray(ball.faces)
    keep = position[faces].mean(1)[:, 2] > 0.2
    faces = faces[keep]
    normal, uv = vertex_normals(position, faces), 0.5 + 0.4 * position[:, :2] + 0.02 * rng.random((len(position), 2))
    result = tangents(position, normal, np.column_stack([uv[:, 0], 1 - uv[:, 1]]), faces)
    expected = reference(position[faces], normal[faces], uv[faces])
    ours = result.tangent[result.faces]
    assert np.array_equal(ours[..., 3], expected[..., 3])
    angle = np.degrees(np.arccos(np.clip((ours[..., :3] * expected[..., :3]).sum(-1), -1, 1)))
    assert np.quantile(angle, 0.999) < 0.1
