"""Ambient occlusion against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.geometry.raycast import RayCaster
from gsbake.texturing.ambient_occlusion import occlusion, smooth_over_surface
from gsbake.texturing.texels import rasterise


@pytest.mark.parametrize("depth", [0.5, 1.0, 2.0])
def test_bottom_of_a_well(depth: float) -> None:
    """At the bottom of a cylinder of radius r and depth h ambient occlusion is r² / (r² + h²)."""
    wall = trimesh.creation.cylinder(radius=1, height=2 * depth, sections=256, cap=False)
    keep = np.abs(wall.face_normals[:, 2]) < 0.5
    caster = RayCaster(wall.vertices, wall.faces[keep])
    n = 500
    value = occlusion(np.zeros((n, 3)), np.tile([0, 0, 1.0], (n, 1)), caster, 64, 1e-4)
    assert value.mean() == pytest.approx(1 / (1 + depth**2), abs=0.01)
    assert value.std() < 0.05  # stratified: random directions would give 0.06 at depth 1


def test_convex_surface_is_unoccluded() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    value = occlusion(ball.vertices, ball.vertices, RayCaster(ball.vertices, ball.faces), 16, 0.02)
    assert value.min() == 1


def test_filter_does_not_cross_depth_edges() -> None:
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    texels = rasterise(uv, np.array([[0, 2, 1], [0, 3, 2]]), 32)
    column = texels.index % 32
    position = np.stack([column, texels.index // 32, np.where(column < 16, 0, 100)], 1).astype(float)
    rng = np.random.default_rng(0)
    value = (np.where(column < 16, 0.2, 0.8) + rng.normal(0, 0.05, len(texels))).astype(np.float32)
    out = smooth_over_surface(texels, value, position, np.tile([0, 0, 1.0], (len(texels), 1)), radius=3.0)
    assert abs(out[column == 15].mean() - 0.2) < 0.02 and abs(out[column == 16].mean() - 0.8) < 0.02
    assert out[column < 16].std() < 0.03


def test_filter_of_channels_is_that_of_each() -> None:
    texels = rasterise(np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.9]]), np.array([[0, 2, 1]]), 24)
    rng, n = np.random.default_rng(1), len(texels)
    position = np.stack([texels.index % 24, texels.index // 24, rng.normal(0, 0.5, n)], 1)
    value, normal = rng.random((n, 3)).astype(np.float32), np.tile([0, 0, 1.0], (n, 1))
    together = smooth_over_surface(texels, value, position, normal, 2.5)
    alone = [smooth_over_surface(texels, channel, position, normal, 2.5) for channel in value.T]
    np.testing.assert_array_equal(together, np.stack(alone, 1))
    assert np.abs(together - value).max() > 0.1
