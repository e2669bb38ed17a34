"""Hollows: predictions, lids, a bowl that opens, and a glossy box that stays closed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from gsbake.capture.hull.softness import surface_softness
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.shape_refinement.appearance import BLACK
from gsbake.shape_refinement.hollows import HollowOptions, open_hollows, seen_part, with_field
from gsbake.shape_refinement.hollows_lids import find_lids, hull_mesh, surface_cells
from gsbake.shape_refinement.hollows_prediction import FLOOR, Prediction, diffuse_errors, reflected_errors
from gsbake.shape_refinement.samples import Photo, sample_photos
from gsbake.shape_refinement.surface import Surface
from tests.shape_refinement.conftest import pattern, smooth_light
from tests.support.cameras import look_at

Shade = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

#: Walls of the hulls of these tests, which have half as many cells.
OPTIONS = HollowOptions(thicknesses=(2.0, 3.1, 4.9, 7.6), cells=20)


def ring(count: int, size: int) -> list[Camera]:
    """Cameras around the origin, from below to high above."""
    cameras = []
    for k in range(count):
        turn, high = 2.4 * k, np.radians(-20 + 95 * (k + 0.5) / count)
        centre = 2.7 * np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        cameras.append(look_at(centre, size=(size, size), focal=1.15 * size, name=f"{k}"))
    return cameras


def scene(mesh: trimesh.Trimesh, shade: Shade, count: int = 20, size: int = 100) -> tuple[Hull, np.ndarray, list[Photo]]:
    """The hull of a mesh on 64³ cells, its softness, and photos."""
    caster, photos, masks = RayCaster(mesh.vertices, mesh.faces), [], []
    cameras = ring(count, size)
    for camera in cameras:
        rays = camera.rays().reshape(-1, 3)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        hits = caster.first_hit(camera.centre[None], rays)
        point = np.where(hits.hit[:, None], caster.points(hits), 0)
        normal = np.einsum("nk,nkd->nd", hits.bary, mesh.vertex_normals[mesh.faces[np.maximum(hits.face, 0)]])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        rgb = np.where(hits.hit[:, None], shade(point, normal, rays), 0).reshape(size, size, 3)
        mask = hits.hit.reshape(size, size).astype(np.float32)
        photos.append(Photo(camera, np.ascontiguousarray(rgb, np.float32), mask))
        masks.append(np.asarray(255 * mask, np.uint8))
    hull = Hull.from_masks(cameras, masks, np.zeros(3), 0.9, 64)
    return hull, surface_softness(hull, cameras, masks), photos


def bowl() -> trimesh.Trimesh:
    """A bowl with a thick wall; the middle of its hollow is at the origin."""
    outer = [(0, -0.5), (0.4, -0.5), (0.6, -0.2), (0.75, 0.3), (0.62, 0.3), (0.47, -0.1), (0.3, -0.3), (0, -0.33)]
    mesh = trimesh.creation.revolve(np.array(outer), sections=48)
    return mesh.subdivide()


def diffuse(point: np.ndarray, normal: np.ndarray, ray: np.ndarray) -> np.ndarray:
    return 0.8 * pattern(point)


def glossy(point: np.ndarray, normal: np.ndarray, ray: np.ndarray) -> np.ndarray:
    return 0.02 + 0.5 * smooth_light(ray - 2 * (ray * normal).sum(1, keepdims=True) * normal)


@pytest.fixture(scope="module")
def bowl_scene() -> tuple[Hull, np.ndarray, list[Photo]]:
    return scene(bowl(), diffuse)


def test_each_photo_is_predicted_by_the_others() -> None:
    """One colour everywhere, photos of different brightness: the errors are those of a loop over vertices and photos."""
    ball = trimesh.creation.icosphere(2, 0.5)
    *_, photos = scene(ball, lambda point, normal, ray: np.full(point.shape, 0.4), size=60)
    uneven = [Photo(one.camera, one.rgb * np.float32(1 + 0.1 * (k % 3)), one.mask) for k, one in enumerate(photos)]
    vertices, faces = 0.95 * ball.vertices, np.ascontiguousarray(ball.faces, np.int32)
    errors = diffuse_errors(vertices, faces, uneven)
    samples = sample_photos(vertices, Surface(len(vertices), faces).normals(vertices), faces, uneven)
    for v in range(0, len(vertices), 9):
        seen = np.flatnonzero(samples.weight[v] > 0)
        assert np.isfinite(errors[v]) == (len(seen) > 3)
        if len(seen) > 3:
            x, w = samples.colour[v, seen].astype(float), samples.weight[v, seen].astype(float)
            left_out = [np.average(np.delete(x, j, 0), axis=0, weights=np.delete(w, j)) for j in range(len(seen))]
            expected = np.average(((x - left_out) ** 2).mean(1), weights=w) / (np.average(x, axis=0, weights=w).mean() + BLACK) ** 2
            assert errors[v] == pytest.approx(expected, rel=1e-3)
    assert np.nanmedian(diffuse_errors(vertices, faces, photos)) < 1e-9


def test_reflections_predict_a_glossy_ball() -> None:
    ball = trimesh.creation.icosphere(4, 0.6)
    *_, photos = scene(ball, glossy, count=32)
    vertices, faces = np.asarray(ball.vertices), np.ascontiguousarray(ball.faces, np.int32)
    reflected, diffuse_only = (errors(vertices, faces, photos) for errors in (reflected_errors, diffuse_errors))
    both = np.isfinite(reflected) & np.isfinite(diffuse_only)
    assert both.mean() > 0.3
    assert Prediction.of(reflected[both]).error < 0.3 * Prediction.of(diffuse_only[both]).error


def test_prediction_is_the_geometric_mean() -> None:
    found = Prediction.of(np.array([1e-2, 1e-4, 1e-2, 1e-4, 1e-2, 1e-4, 50.0], np.float32))
    assert found.error == pytest.approx((1.001e-2**3 * 1.1e-4**3 * 1.0) ** (1 / 7), rel=1e-3) and found.seen == 7
    assert Prediction.of(np.zeros(5, np.float32)).error == pytest.approx(FLOOR)
    assert np.isnan(Prediction.of(np.zeros(4, np.float32)).error)


def test_the_lid_of_a_bowl_is_found(bowl_scene: tuple[Hull, np.ndarray, list[Photo]]) -> None:
    hull, softness, photos = bowl_scene
    lid = next(find_lids(hull, softness, photos))
    cells = np.argwhere(lid.cells)
    places = hull.lower + (cells + 0.5) * hull.cell
    assert (lid.cells <= surface_cells(hull.occupancy)).all()
    assert (places[:, 2] > 0.2).mean() > 0.95 and np.hypot(*places[:, :2].T).max() < 0.8
    assert np.hypot(*places[:, :2].T).max() > 0.5
    assert lid.prediction.error > 0.02


def test_a_bowl_opens(bowl_scene: tuple[Hull, np.ndarray, list[Photo]]) -> None:
    hull, softness, photos = bowl_scene
    # Air of the hollow, and clay below it.
    unit = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    air, clay = unit * [0.3, 0.3, 0.15] + [0, 0, 0.08], unit * [0.2, 0.2, 0.03] - [0, 0, 0.45]
    assert (hull.signed_distance(air) < 0).all()
    opened, verdicts = open_hollows(hull, softness, lambda size: photos, OPTIONS)
    assert verdicts[0].cells == (hull.occupancy & ~opened.occupancy).sum() > 0
    assert verdicts[0].opened < 0.05 * verdicts[0].closed
    assert (opened.signed_distance(air) > 0).mean() > 0.9
    assert (opened.signed_distance(clay) < 0).all()
    assert (opened.field >= hull.field).all()


def test_a_stop_ends_between_proposals(bowl_scene: tuple[Hull, np.ndarray, list[Photo]]) -> None:
    hull, softness, photos = bowl_scene
    steps = iter(range(3))
    with pytest.raises(StopIteration):
        open_hollows(hull, softness, lambda size: photos, OPTIONS, on_step=lambda: next(steps) and None)
    assert len(list(find_lids(hull, softness, photos))) < 3  # it ended inside of one lid


def test_a_glossy_box_stays_closed() -> None:
    box = trimesh.creation.box((1.1, 0.7, 0.5))
    for _ in range(4):
        box = box.subdivide()
    inner = np.array([0.45, 0.25, 0.15])
    core = np.clip(box.vertices, -inner, inner)
    away = box.vertices - core
    rounded = core + 0.1 * away / np.linalg.norm(away, axis=1, keepdims=True)
    hull, softness, photos = scene(trimesh.Trimesh(rounded, box.faces, process=False), glossy)
    opened, verdicts = open_hollows(hull, softness, lambda size: photos, OPTIONS)
    assert verdicts  # photos disagree about its colour
    assert (opened.field == hull.field).all()


def test_what_no_photo_sees_stays_solid() -> None:
    """A cavity inside of a ball, and a shaft that leads from outside into it."""
    hull, _, photos = scene(trimesh.creation.icosphere(3, 0.6), diffuse)
    x, y, z = np.moveaxis(hull.lower + (np.indices(hull.field.shape).T + 0.5) * hull.cell, -1, 0).transpose(0, 3, 2, 1)
    cavity = np.maximum(hull.field, 0.3 - np.sqrt(x**2 + y**2 + z**2))
    assert (seen_part(hull, with_field(hull, cavity), photos, 1).field == hull.field).all()
    shaft = np.maximum(cavity, np.where(z > 0, 0.12 - np.hypot(x, y), -1))
    opened = seen_part(hull, with_field(hull, shaft), photos, 1)
    assert opened.signed_distance(np.array([[0, 0, 0.4]]))[0] > 0
    assert opened.signed_distance(np.array([[0, 0, -0.2]]))[0] < 0  # no camera looks so steeply


def test_without_photos_that_see_it_the_hull_stays(bowl_scene: tuple[Hull, np.ndarray, list[Photo]]) -> None:
    hull, softness, photos = bowl_scene
    blind = [Photo(photo.camera, photo.rgb, np.zeros_like(photo.mask)) for photo in photos]
    opened, verdicts = open_hollows(hull, softness, lambda size: blind, OPTIONS)
    assert (opened.field == hull.field).all() and not verdicts


def test_a_leaf_has_no_hollows(bowl_scene: tuple[Hull, np.ndarray, list[Photo]]) -> None:
    """A hull of one layer of cells, as of a leaf or a sheet of paper: nothing of it is left on blocks of cells."""
    hull, softness, photos = bowl_scene
    field = np.full(hull.field.shape, 2 * hull.cell)
    field[16:48, 16:48, 32] = -0.1 * hull.cell
    opened, verdicts = open_hollows(with_field(hull, field), softness, lambda size: photos, OPTIONS)
    assert opened.occupancy.sum() == 32 * 32 and not verdicts


def test_the_mesh_of_a_hull_has_its_size(bowl_scene: tuple[Hull, np.ndarray, list[Photo]]) -> None:
    hull = bowl_scene[0]
    vertices, faces = hull_mesh(hull)
    fine, _ = hull.triangles()
    assert faces.max() < len(vertices) < len(fine) / 3
    assert np.abs(hull.signed_distance(vertices)).max() < 1.5 * hull.cell
