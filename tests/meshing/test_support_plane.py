"""Support plane: detected exactly where there is one, removed from the field, object kept whole."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing import cleanup as clean
from gsbake.meshing.depth_views import DepthView
from gsbake.meshing.support_plane import SupportPlane, find_support_plane, remove_background_components
from gsbake.meshing.tsdf import SparseTsdf
from tests.meshing.scenes import Array, cameras_around, trace

CELL = 2 / 72
FLOOR, RADIUS = -0.35, 0.4
UP = np.array([0.0, 0.0, 1.0])


def sphere(p: Array) -> Array:
    return np.linalg.norm(p, axis=-1) - RADIUS


def object_on_table(p: Array) -> Array:
    return np.minimum(sphere(p), p[..., 2] - FLOOR)


def samples(disc: float, with_object: bool = True, tilt: float = 0.0, noise: float = 0.003) -> tuple[Array, Array, Array]:
    """Points, normals and weights of a sphere on a disc of radius `disc`, rotated by `tilt` around x."""
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 6000), disc * np.sqrt(rng.uniform(0, 1, 6000))
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), FLOOR + noise * rng.normal(size=6000)], 1)
    normal = np.tile(UP, (6000, 1)) + 0.05 * rng.normal(size=(6000, 3))
    if with_object:
        body = rng.normal(size=(3000, 3))
        body /= np.linalg.norm(body, axis=1, keepdims=True)
        keep = RADIUS * body[:, 2] > FLOOR
        flat, normal = np.concatenate([flat, RADIUS * body[keep]]), np.concatenate([normal, body[keep]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rotation = rotation_x(tilt)
    return flat @ rotation.T, normal @ rotation.T, np.ones(len(flat))


def rotation_x(tilt: float) -> Array:
    return np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])


def centres(elevations: tuple[float, ...] = (20, 50), tilt: float = 0.0) -> Array:
    return np.stack([c.centre for c in cameras_around(elevations)]) @ rotation_x(tilt).T


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_table_is_detected(tilt: float) -> None:
    found, evidence = find_support_plane(*samples(0.93, tilt=tilt), centres(tilt=tilt), 3)
    assert found is not None, evidence
    assert np.degrees(np.arccos(found.normal @ rotation_x(tilt) @ UP)) < 0.5
    assert found.offset == pytest.approx(FLOOR, abs=0.002)
    assert 2 * 0.003 < found.cut < 4 * 0.003  # slightly above the noise of the table


@pytest.mark.parametrize(
    ("disc", "with_object", "elevations", "reason"),
    [
        (0.5, True, (20, 50), "ends inside the unit ball"),  # a stand that belongs to the object
        (0.93, False, (20, 50), "stands on"),  # a relief: only the plane
        (0.93, True, (50, -50), "taken from behind"),  # a shelf seen from both sides
    ],
)
def test_planes_that_are_no_support(disc: float, with_object: bool, elevations: tuple[float, ...], reason: str) -> None:
    found, evidence = find_support_plane(*samples(disc, with_object), centres(elevations), 3)
    assert found is None and reason in evidence


def test_sphere_has_none() -> None:
    body = np.random.default_rng(1).normal(size=(4000, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    found, evidence = find_support_plane(0.9 * body, body, np.ones(4000), centres(), 3)
    assert found is None and "% of the surface" in evidence


def fused(support: SupportPlane | None) -> tuple[Array, np.ndarray]:
    field = SparseTsdf([-1.2] * 3, [1.2] * 3, CELL, 4 * CELL, ball=1.05, empty_outside=support is not None, support=support)
    views = []
    for camera in cameras_around((15, 50)):
        depth, _, cosine = trace(object_on_table, camera)
        views.append(DepthView.from_depth(camera, depth, np.where(cosine > 0.1, cosine, 0).astype(np.float32), np.maximum(cosine, 0.1)))
    for view in views:
        field.fuse_coarse(view)
    field.allocate()
    for view in views:
        field.integrate(view)
    return field.mesh()


def test_object_on_table_is_isolated_and_closed() -> None:
    with_table = fused(None)[0]
    assert np.abs(with_table[:, :2]).max() > 0.8
    support = SupportPlane(UP, FLOOR, 0.02)
    vertices, faces = fused(support)
    topology = clean.topology(vertices, faces)
    assert topology.watertight and topology.components == 1
    height = support.height(vertices)
    assert height.min() > 0.02 - 0.1 * CELL
    above = height > 0.02 + 3 * CELL
    assert np.abs(sphere(vertices[above])).mean() < 0.15 * CELL
    flat = np.abs(height - 0.02) < 0.1 * CELL  # the cut is a disc with the radius of the sphere at that height
    assert np.linalg.norm(vertices[flat, :2], axis=1).max() == pytest.approx(np.sqrt(RADIUS**2 - (FLOOR + 0.02) ** 2), abs=1.5 * CELL)
    projected = support.snap_to_plane(vertices, CELL)
    assert support.height(projected).min() == pytest.approx(0, abs=1e-9)
    assert np.array_equal(projected[~flat & above], vertices[~flat & above])


def box(centre: tuple[float, float, float], size: float) -> trimesh.Trimesh:
    return trimesh.creation.box((size,) * 3, trimesh.transformations.translation_matrix(centre))


@pytest.mark.parametrize(("size_centre", "remaining"), [(0.5, 1), (0.1, 2)])
def test_outer_components_are_removed_when_there_is_a_central_one(size_centre: float, remaining: int) -> None:
    both = box((0, 0, 0), size_centre) + box((0.8, 0, 0), 0.5)
    vertices, faces, removed = remove_background_components(np.array(both.vertices), np.array(both.faces, np.int32), 1.0)
    assert clean.topology(vertices, faces).components == remaining and removed == 2 - remaining
    if removed:
        assert np.abs(vertices).max() == pytest.approx(size_centre / 2)
