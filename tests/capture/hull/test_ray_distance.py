"""Rays past and through the visual hull of a ball: the distances have a closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.capture.hull.ray_distance import ray_distance
from gsbake.capture.hull.visual_hull import Hull
from tests.support.cameras import look_at

CENTRE, RADIUS, CELLS = np.array([0.1, -0.05, 0.2]), 0.5, 96


def ball() -> Hull:
    """The exact signed distance of a ball on a grid."""
    cell = 2.0 / CELLS
    axis = -1 + (np.arange(CELLS) + 0.5) * cell
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    field = (np.linalg.norm(grid - CENTRE, axis=-1) - RADIUS).astype(np.float32)
    return Hull(field < 0, np.full(3, -1.0), cell, field)


@pytest.mark.parametrize("eye", [[0.0, -3.0, 0.3], [2.0, 1.5, 1.8]])
def test_distance_to_a_ball(eye: list[float]) -> None:
    """The nearest point of a ray is where the distance to the centre is least; in pixels at its depth, where the field changes slowly."""
    camera, greatest = look_at(np.array(eye), size=120, focal=110), 5.0
    rays = camera.rays()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = CENTRE - camera.centre
    along = rays @ offset
    depth = along * (rays @ camera.R[2])
    expected = (np.linalg.norm(offset - along[..., None] * rays, axis=-1) - RADIUS) * camera.fx / depth
    found = ray_distance(ball(), camera, greatest)
    inner, near = expected < -greatest - 1, np.abs(expected) < greatest - 1
    assert near.sum() > 500 and inner.sum() > 300
    assert np.abs(found[near] - expected[near]).max() < 0.15
    assert (found[inner] < -greatest).all() and (found[expected > greatest + 1] > greatest - 0.5).all()


def test_a_ray_away_from_the_grid_is_infinitely_far() -> None:
    camera = look_at(np.array([0.0, -3.0, 0.0]), np.array([0.0, -8.0, 0.0]), size=16, focal=60)
    assert np.isinf(ray_distance(ball(), camera, 2.0)).all()
