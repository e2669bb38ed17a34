"""Ray casting against analytic hits and trimesh's intersector."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster

BOX = trimesh.creation.box((1.0, 2.0, 3.0))


def test_box_hits_are_analytic() -> None:
    caster = RayCaster(BOX.vertices, BOX.faces)
    origins = np.array([[5.0, 0.3, 0.7], [0.1, -4.0, -1.2], [5.0, 1.5, 0.0], [0.1, 0.2, 0.3]])
    directions = np.array([[-2.0, 0.0, 0.0], [0.0, 0.5, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    hits = caster.first_hit(origins, directions)
    np.testing.assert_allclose(hits.distance, [4.5 / 2, 3.0 / 0.5, np.inf, 1.2 / 4], rtol=1e-5)
    assert hits.face[2] == -1 and (hits.face[[0, 1, 3]] >= 0).all()
    np.testing.assert_allclose(caster.points(hits)[[0, 1, 3]], [[0.5, 0.3, 0.7], [0.1, -1.0, -1.2], [0.1, 0.2, 1.5]], atol=1e-6)
    np.testing.assert_allclose(hits.bary.sum(1), [1, 1, 0, 1], atol=1e-6)


def test_sphere_distance_and_trimesh_agree() -> None:
    ball = trimesh.creation.icosphere(5)
    rng = np.random.default_rng(3)
    target = rng.normal(size=(400, 3))
    target *= (0.8 * rng.random(400) / np.linalg.norm(target, axis=1))[:, None]
    origins = rng.normal(size=(400, 3))
    origins *= (2.5 / np.linalg.norm(origins, axis=1))[:, None]
    directions = (target - origins) * rng.uniform(0.2, 3, (400, 1))
    caster = RayCaster(ball.vertices, ball.faces)
    hits = caster.first_hit(origins, directions)
    a = (directions**2).sum(1)
    b = (origins * directions).sum(1)
    exact = (-b - np.sqrt(b * b - a * ((origins**2).sum(1) - 1))) / a
    np.testing.assert_allclose(hits.distance * np.sqrt(a), exact * np.sqrt(a), atol=2e-3)  # facets lie inside the sphere
    reference = ball.ray.intersects_first(origins, directions)
    assert (hits.face == reference).mean() > 0.99


def test_translation_and_units_do_not_matter() -> None:
    move, scale = np.array([4000.0, -700.0, 90.0]), 1e-3
    caster = RayCaster(BOX.vertices * scale + move, BOX.faces)
    hits = caster.first_hit(np.array([[5.0, 0.3, 0.7]]) * scale + move, [[-1.0, 0, 0]])
    assert hits.distance[0] == pytest.approx(4.5 * scale, rel=1e-4)


def test_occlusion_respects_the_distance() -> None:
    caster = RayCaster(BOX.vertices, BOX.faces)
    origin = np.array([[2.0, 0, 0]])
    assert caster.occluded(origin, [[-1.0, 0, 0]])[0]
    assert caster.occluded(origin, [[-1.0, 0, 0]], max_distance=1.6)[0]
    assert not caster.occluded(origin, [[-1.0, 0, 0]], max_distance=1.4)[0]
    assert not caster.occluded(origin, [[1.0, 0, 0]])[0]


def test_result_does_not_depend_on_chunks_and_threads() -> None:
    caster = RayCaster(BOX.vertices, BOX.faces, threads=2)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(150_000, 3))
    whole = caster.first_hit([[4.0, 0, 0]], directions)
    part = caster.first_hit([[4.0, 0, 0]], directions[-1000:])
    np.testing.assert_array_equal(whole.face[-1000:], part.face)
    np.testing.assert_array_equal(whole.distance[-1000:], part.distance)


def test_depth_is_along_the_axis_at_pixel_centres() -> None:
    camera = Camera("c", 8, 6, 10.0, 10.0, 4.0, 3.0, np.eye(3), np.array([0.0, 0.0, 5.0]))
    depth = RayCaster(BOX.vertices, BOX.faces).depth(camera)
    assert depth.shape == (6, 8) and depth.dtype == np.float32
    visible = depth > 0
    np.testing.assert_allclose(depth[visible], 3.5, rtol=1e-5)
    # Half widths of the front face at z = 3.5 are 0.5 and 1.0: |x - 4| / 10 * 3.5 < 0.5 at centres .5 and 1.5 off the middle column.
    x = np.abs(np.arange(8) + 0.5 - 4) * 0.35 < 0.5
    y = np.abs(np.arange(6) + 0.5 - 3) * 0.35 < 1.0
    np.testing.assert_array_equal(visible, y[:, None] & x[None, :])


def test_no_faces_and_no_rays() -> None:
    empty = RayCaster(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert not empty.first_hit(np.zeros((2, 3)), np.ones((2, 3))).hit.any()
    assert not empty.occluded(np.zeros((2, 3)), np.ones((2, 3))).any()
    assert len(RayCaster(BOX.vertices, BOX.faces).first_hit(np.zeros((0, 3)), np.zeros((0, 3))).face) == 0
