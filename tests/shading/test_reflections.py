"""Traced reflections: a floor that mirrors a wall."""

from __future__ import annotations

import numpy as np

from gsbake.geometry.raycast import RayCaster
from gsbake.shading.reflections import trace_reflections

#: A floor 4 × 4 at z = 0 (faces 0 and 1) and a wall 2 high at x = 1 (faces 2 and 3).
VERTICES = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0], [1, -2, 0], [1, 2, 0], [1, 2, 2], [1, -2, 2]]
FACES = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
CASTER = RayCaster(VERTICES, FACES, 1)


def test_a_mirrored_ray_meets_the_wall_where_it_should() -> None:
    position, normal = np.array([[0.0, 0.0, 0.0], [-0.5, 1.0, 0.0]]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]])
    view = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]) / np.sqrt(2)  # towards the wall, and away from it
    sent, hits = trace_reflections(CASTER, np.array([0, 1]), position, normal, view, 1e-4)
    assert sent.tolist() == [0, 1]
    assert hits.face[0] in (2, 3) and abs(float(hits.distance[0]) - np.sqrt(2)) < 1e-3
    assert hits.face[1] == -1


def test_rays_below_the_geometric_horizon_are_left_out() -> None:
    position = np.zeros((2, 3))
    normal = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.2]])  # the second one turns the reflected ray into the floor
    view = np.array([[-0.6, 0.0, 0.8], [0.6, 0.0, 0.8]])
    sent, hits = trace_reflections(CASTER, np.array([0, 0]), position, normal, view, 1e-4)
    assert sent.tolist() == [0] and len(hits.face) == 1
