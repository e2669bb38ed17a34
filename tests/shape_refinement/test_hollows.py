"""Hollows: the kernel against its twin, the cut, a bowl that opens, and a glossy box that stays closed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize_scalar

from gsbake.capture.hull.softness import surface_softness
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.shape_refinement.hollows import HollowOptions, open_hollows
from gsbake.shape_refinement.hollows_cut import cut_cells
from gsbake.shape_refinement.hollows_front import unexplained
from gsbake.shape_refinement.hollows_kernel import ROUNDS, parallax_rows
from gsbake.shape_refinement.samples import Photo
from tests.shape_refinement.conftest import pattern, smooth_light
from tests.support.cameras import look_at

Shade = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def rows_twin(colour: np.ndarray, slope: np.ndarray, weight: np.ndarray, floor: float) -> np.ndarray:
    """One vertex's row of `parallax_rows`, from the formulas."""
    mean = np.average(colour, axis=0, weights=weight)
    scale = 2 * (np.average(((colour - mean) ** 2).sum(1), weights=weight) + floor**2)
    for _ in range(ROUNDS):
        square = ((colour - mean) ** 2).sum(1)
        used = weight / (1 + square / scale)
        new = np.average(colour, axis=0, weights=used)
        variance, mean = np.average(square, weights=weight), new
    row = slope - np.average(slope, axis=0, weights=used)
    h = (used[:, None] * row**2).sum()
    g = (used[:, None] * row * (colour - mean)).sum()
    return np.array([h, g, variance, used.sum()])


def test_rows() -> None:
    draw = np.random.default_rng(0)
    colour, slope = (draw.normal(size=(20, 9, 3)).astype(np.float32) for _ in range(2))
    weight = (draw.uniform(size=(20, 9)) * (draw.uniform(size=(20, 9)) > 0.3)).astype(np.float32)
    weight[3] = 0
    out = np.ones((20, 4))
    parallax_rows(0, 20, colour, slope, weight, 0.02, out)
    assert (out[3] == 0).all()
    for v in (v for v in range(20) if v != 3):
        seen = weight[v] > 0
        expected = rows_twin(*(values[v, seen].astype(float) for values in (colour, slope, weight)), 0.02)
        assert out[v] == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_rows_are_the_parallax_of_the_squared_error() -> None:
    """g and h are half the first and second derivative of the weighted error for a move, the colour in closed form."""
    draw = np.random.default_rng(1)
    colour, slope, weight = draw.normal(size=(7, 3)), draw.normal(size=(7, 3)), draw.uniform(0.2, 1, 7)
    # Without contrast beyond the floor all weights are equal, so that the error is a plain quadratic.
    colour, slope = 1e-6 * colour, 1e-6 * slope
    out = np.zeros((1, 4))
    parallax_rows(0, 1, colour[None].astype(np.float32), slope[None].astype(np.float32), weight[None].astype(np.float32), 1.0, out)

    def error(move: float) -> float:
        moved = colour + move * slope
        return float((weight[:, None] * (moved - np.average(moved, axis=0, weights=weight)) ** 2).sum())

    e = 0.1
    assert out[0, 1] == pytest.approx((error(e) - error(-e)) / (4 * e), rel=1e-4)
    assert out[0, 0] == pytest.approx((error(e) - 2 * error(0) + error(-e)) / (2 * e * e), rel=1e-4)


def test_a_displacement_explains_as_much_as_the_best_of_all() -> None:
    rows = np.array([[2.0, -1.0, 5.0, 4.0], [2.0, 8.0, 50.0, 4.0], [0.0, 0.0, 1.0, 0.0]])
    for (h, g, variance, share), left in zip(rows, unexplained(rows, 1.0), strict=True):
        best = minimize_scalar(
            lambda d, h=h, g=g, variance=variance, share=share: variance + (2 * g * d + h * d * d) / max(share, 1e-30),
            bounds=(-1, 1), method="bounded",
        )  # fmt: skip
        assert left == pytest.approx(best.fun, abs=1e-4)


def test_the_cut_goes_through_the_cheapest_cells() -> None:
    removed, left = np.zeros((8, 8, 12), bool), np.zeros((8, 8, 12), bool)
    removed[2:6, 2:6, 3:9] = True
    left[1:7, 1:7, 2:9] = True
    left &= ~removed  # a box with a shaft that opens at 9
    cost = np.full(removed.shape, 2, np.float32)
    assert not cut_cells(removed, left, cost, 0.1).any()  # the lid is the smallest surface
    cost[:] = 0.01
    cost[3:5, 3:5, 7:] = 50  # a surface there is dear, and beside it cheap
    air = cut_cells(removed, left, cost, 0.001)
    assert air[3:5, 3:5, 7:9].all()
    assert not (air & ~removed).any()


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


def matte(point: np.ndarray, normal: np.ndarray, ray: np.ndarray) -> np.ndarray:
    return 0.8 * pattern(point)


def glossy(point: np.ndarray, normal: np.ndarray, ray: np.ndarray) -> np.ndarray:
    return 0.02 + 0.5 * smooth_light(ray - 2 * (ray * normal).sum(1, keepdims=True) * normal)


def test_a_bowl_opens() -> None:
    hull, softness, photos = scene(bowl(), matte)
    # Air of the hollow, and clay below it.
    unit = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    air, clay = unit * [0.3, 0.3, 0.15] + [0, 0, 0.08], unit * [0.2, 0.2, 0.03] - [0, 0, 0.45]
    assert (hull.signed_distance(air) < 0).all()
    opened, verdicts = open_hollows(hull, softness, lambda size: photos, HollowOptions(rounds=1))
    assert verdicts[0].accepted and verdicts[0].opened < 0.1 * verdicts[0].closed
    assert (opened.signed_distance(air) > 0).mean() > 0.75
    assert (opened.signed_distance(clay) < 0).all()
    assert (opened.field >= hull.field).all()


def test_a_glossy_box_stays_closed() -> None:
    box = trimesh.creation.box((1.1, 0.7, 0.5))
    for _ in range(4):
        box = box.subdivide()
    inner = np.array([0.45, 0.25, 0.15])
    core = np.clip(box.vertices, -inner, inner)
    away = box.vertices - core
    rounded = core + 0.1 * away / np.linalg.norm(away, axis=1, keepdims=True)
    hull, softness, photos = scene(trimesh.Trimesh(rounded, box.faces, process=False), glossy)
    opened, _ = open_hollows(hull, softness, lambda size: photos, HollowOptions(rounds=1))
    assert ((hull.field < 0) & (opened.field >= 0)).sum() < 0.005 * (hull.field < 0).sum()


def test_without_photos_that_see_it_the_hull_stays() -> None:
    hull, softness, photos = scene(bowl(), matte, count=8)
    blind = [Photo(photo.camera, photo.rgb, np.zeros_like(photo.mask)) for photo in photos]
    opened, verdicts = open_hollows(hull, softness, lambda size: blind, HollowOptions(rounds=1, steps=3))
    assert (opened.field == hull.field).all() and not verdicts
