"""The baked normal map of a bumpy sphere against its analytic normals."""

from __future__ import annotations

import numpy as np
import trimesh

from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.tangents import frame_to_world, tangents
from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.normal_map import normal_map, sample_dense_mesh, vertex_normals
from gsbake.texturing.texels import rasterise

AMPLITUDE = 0.015


def radius(direction: np.ndarray) -> np.ndarray:
    return 1 + AMPLITUDE * np.sin(9 * direction[:, 0]) * np.cos(8 * direction[:, 1] + 3 * direction[:, 2])


def true_normal(direction: np.ndarray) -> np.ndarray:
    """Gradient of |p| - radius(p / |p|) at the surface, by central differences."""
    p = direction * radius(direction)[:, None]

    def field(q: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(q, axis=1)
        return length - radius(q / length[:, None])

    step = 1e-5
    gradient = np.stack([field(p + step * e) - field(p - step * e) for e in np.eye(3)], 1)
    return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))


def test_normal_map_of_a_bumpy_sphere() -> None:
    low_poly, dense = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.icosphere(subdivisions=6)
    fine = np.asarray(dense.vertices)
    caster = RayCaster(fine * radius(fine)[:, None], dense.faces)
    smooth = vertex_normals(caster.vertices, caster.faces)
    points, faces = np.asarray(low_poly.vertices), np.asarray(low_poly.faces)
    atlas = make_atlas(points, faces, 256)
    position, normal = points[atlas.source], vertex_normals(points, faces)[atlas.source]
    frames = tangents(position, normal, atlas.uv, atlas.faces)
    texels = rasterise(atlas.uv, frames.faces, 256)
    n, t = texels.interpolate(normal, frames.faces), texels.interpolate(frames.tangent, frames.faces)
    detail = sample_dense_mesh(texels.interpolate(position, frames.faces), n, caster, smooth, 2 * np.sqrt(3))
    assert detail.found.mean() > 0.999
    coded = np.rint(normal_map(detail, n, t) * 255) / 127.5 - 1  # what an 8-bit texture keeps
    shaded = frame_to_world(coded, n, t)
    direction = detail.position / np.linalg.norm(detail.position, axis=1, keepdims=True)
    error = degrees(shaded, true_normal(direction))
    assert error.mean() < 1.0 and np.quantile(error, 0.99) < 2.5
    # Without the map the low-poly mesh is several degrees off.
    assert degrees(n / np.linalg.norm(n, axis=1, keepdims=True), true_normal(direction)).mean() > 3


def test_texels_without_a_dense_surface_stay_flat() -> None:
    away = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    caster = RayCaster(away.vertices + [5.0, 0, 0], away.faces)
    position, normal = np.zeros((4, 3)), np.tile([0.0, 0, 1], (4, 1))
    detail = sample_dense_mesh(position, normal, caster, vertex_normals(caster.vertices, caster.faces), 2.0)
    assert not detail.found.any()
    tangent = np.tile([1.0, 0, 0, 1], (4, 1))
    assert np.allclose(normal_map(detail, normal, tangent), [0.5, 0.5, 1])


def test_opposite_side_of_a_thin_wall_is_ignored() -> None:
    corner = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    wall = RayCaster(corner + [0, 0, -0.01], np.array([[0, 2, 1], [0, 3, 2]]))  # faces -z
    detail = sample_dense_mesh(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), wall, vertex_normals(wall.vertices, wall.faces), 3.0)
    assert not detail.found.any()


def test_vertex_normals_of_a_sphere_point_outwards() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert degrees(vertex_normals(ball.vertices, ball.faces), np.asarray(ball.vertices)).max() < 0.5
