"""The plane an object stands on: found where there is one, and only there; left out of the field; what stands on it stays whole."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing import cleanup as clean
from gsbake.meshing.depth_views import DepthView
from gsbake.meshing.support_plane import Support, drop_surroundings, find_support
from gsbake.meshing.tsdf import SparseTsdf
from tests.meshing.scenes import Array, cameras_around, trace

CELL = 2 / 72
FLOOR, RADIUS = -0.35, 0.4
UP = np.array([0.0, 0.0, 1.0])


def egg(p: Array) -> Array:
    return np.linalg.norm(p, axis=-1) - RADIUS


def standing(p: Array) -> Array:
    return np.minimum(egg(p), p[..., 2] - FLOOR)


def samples(disc: float, ball: bool = True, tilt: float = 0.0, noise: float = 0.003) -> tuple[Array, Array, Array]:
    """Points, normals and weights of an egg that stands on a disc of that radius, turned by `tilt` around x."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 6000), disc * np.sqrt(rng.uniform(0, 1, 6000))
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), FLOOR + noise * rng.normal(size=6000)], 1)
    normal = np.tile(UP, (6000, 1)) + 0.05 * rng.normal(size=(6000, 3))
    if ball:
        body = rng.normal(size=(3000, 3))
        body /= np.linalg.norm(body, axis=1, keepdims=True)
        keep = RADIUS * body[:, 2] > FLOOR
        flat, normal = np.concatenate([flat, RADIUS * body[keep]]), np.concatenate([normal, body[keep]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn = turned(tilt)
    return flat @ turn.T, normal @ turn.T, np.ones(len(flat))


def turned(tilt: float) -> Array:
    return np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])


def centres(elevations: tuple[float, ...] = (20, 50), tilt: float = 0.0) -> Array:
    return np.stack([c.centre for c in cameras_around(elevations)]) @ turned(tilt).T


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_table_is_found(tilt: float) -> None:
    found, evidence = find_support(*samples(0.93, tilt=tilt), centres(tilt=tilt), 3)
    assert found is not None, evidence
    assert np.degrees(np.arccos(found.normal @ turned(tilt) @ UP)) < 0.5
    assert found.offset == pytest.approx(FLOOR, abs=0.002)
    assert 2 * 0.003 < found.cut < 4 * 0.003  # above the table's own noise, not far above


@pytest.mark.parametrize(
    ("disc", "ball", "elevations", "why"),
    [
        (0.5, True, (20, 50), "ends before the rim"),  # a stand that belongs to the object
        (0.93, False, (20, 50), "stands on"),  # a relief: there is nothing but the plane
        (0.93, True, (50, -50), "taken from behind"),  # a shelf seen from both sides
    ],
)
def test_what_is_no_support(disc: float, ball: bool, elevations: tuple[float, ...], why: str) -> None:
    found, evidence = find_support(*samples(disc, ball), centres(elevations), 3)
    assert found is None and why in evidence


def test_a_round_thing_has_none() -> None:
    body = np.random.default_rng(1).normal(size=(4000, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    found, evidence = find_support(0.9 * body, body, np.ones(4000), centres(), 3)
    assert found is None and "% of the surface" in evidence


def fused(support: Support | None) -> tuple[Array, np.ndarray]:
    field = SparseTsdf([-1.2] * 3, [1.2] * 3, CELL, 4 * CELL, ball=1.05, solid=support is not None, support=support)
    views = []
    for camera in cameras_around((15, 50)):
        depth, _, cosine = trace(standing, camera)
        views.append(DepthView.of(camera, depth, np.where(cosine > 0.1, cosine, 0).astype(np.float32), np.maximum(cosine, 0.1)))
    for view in views:
        field.survey(view)
    field.allocate()
    for view in views:
        field.integrate(view)
    return field.mesh()


def test_what_stands_on_a_table_comes_alone_and_closed() -> None:
    with_table = fused(None)[0]
    assert np.abs(with_table[:, :2]).max() > 0.8
    support = Support(UP, FLOOR, 0.02)
    vertices, faces = fused(support)
    shape = clean.topology(vertices, faces)
    assert shape.watertight and shape.components == 1
    height = support.height(vertices)
    assert height.min() > 0.02 - 0.1 * CELL
    above = height > 0.02 + 3 * CELL
    assert np.abs(egg(vertices[above])).mean() < 0.15 * CELL
    flat = np.abs(height - 0.02) < 0.1 * CELL  # the cut goes right through, with the radius of the egg at that height
    assert np.linalg.norm(vertices[flat, :2], axis=1).max() == pytest.approx(np.sqrt(RADIUS**2 - (FLOOR + 0.02) ** 2), abs=1.5 * CELL)
    grounded = support.ground(vertices, CELL)
    assert support.height(grounded).min() == pytest.approx(0, abs=1e-9)
    assert np.array_equal(grounded[~flat & above], vertices[~flat & above])


def box(centre: tuple[float, float, float], size: float) -> trimesh.Trimesh:
    return trimesh.creation.box((size,) * 3, trimesh.transformations.translation_matrix(centre))


@pytest.mark.parametrize(("inner", "left"), [(0.5, 1), (0.1, 2)])
def test_pieces_at_the_rim_go_where_something_stands_in_the_middle(inner: float, left: int) -> None:
    both = box((0, 0, 0), inner) + box((0.8, 0, 0), 0.5)
    vertices, faces, gone = drop_surroundings(np.array(both.vertices), np.array(both.faces, np.int32), 1.0)
    assert clean.topology(vertices, faces).components == left and gone == 2 - left
    if gone:
        assert np.abs(vertices).max() == pytest.approx(inner / 2)
