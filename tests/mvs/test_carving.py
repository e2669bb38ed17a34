"""Carving of a ball with a bowl: the visual hull is the whole ball, and depths inside the bowl carve it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.hull.softness import SOFT, surface_softness
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.mvs.carving import REGION, REMAINDER, _carvable_regions, _grow, carve_hull, count_empty_rays, count_votes
from gsbake.mvs.depth_maps import z_depth
from gsbake.mvs.mirror_images import SOFT_BORDER
from tests.mvs.scenes import RADIUS, camera_at, sphere_depth

Array = NDArray[np.float64]
#: Centre and radius of the ball that is subtracted.
BOWL, HOLLOW = np.array([RADIUS + 0.18, 0.0, 0.0]), 0.35
CELLS = 64


def views() -> list[Camera]:
    """Twelve cameras around +x, at most 50 degrees from it, and six behind."""
    directions = [(1, 0.5 * np.cos(a), 0.5 * np.sin(a)) for a in np.arange(6)]
    directions += [(1, np.cos(a), np.sin(a)) for a in np.arange(6) + 0.5]
    directions += [(-1, np.cos(a), np.sin(a)) for a in np.arange(6)]
    return [camera_at(3.0 * np.array(d) / np.linalg.norm(d), f"{i:02d}", 110, 95) for i, d in enumerate(directions)]


def ball() -> Hull:
    """The exact signed distance of the whole ball."""
    cell = 2 / CELLS
    axis = (np.arange(CELLS) + 0.5) * cell - 1
    field = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij")), axis=0) - RADIUS
    return Hull(field < 0, np.full(3, -1.0), cell, field.astype(np.float32))


def ball_softness(hull: Hull) -> NDArray[np.float32]:
    """Softness of the ball's hull from 60 photos around it, with the opening of the bowl soft, as long chords make it."""
    z, turn = np.linspace(-0.97, 0.97, 60), np.pi * (3 - np.sqrt(5)) * np.arange(60)
    eyes = 3.0 * np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    cameras = [camera_at(eye, f"{i:02d}", 110, 95) for i, eye in enumerate(eyes)]
    softness = surface_softness(hull, cameras, [255 * (sphere_depth(c) > 0).astype(np.uint8) for c in cameras])
    axis = hull.lower[0] + (np.arange(CELLS) + 0.5) * hull.cell
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return np.where(np.linalg.norm(cells - BOWL, axis=-1) < HOLLOW, 2 * SOFT, softness).astype(np.float32)


def bowl_depth(camera: Camera) -> Array:
    """z-depth (h, w) of the ball minus the bowl: rays that enter through the bowl's opening hit its far side."""
    depth, rays = sphere_depth(camera), camera.rays()
    entry = camera.centre + depth[..., None] * rays
    in_bowl = (depth > 0) & (np.linalg.norm(entry - BOWL, axis=-1) < HOLLOW)
    to = camera.centre - BOWL
    a, b = (rays**2).sum(-1), rays @ to
    far = (-b + np.sqrt(np.maximum(b * b - a * (to @ to - HOLLOW**2), 0))) / a
    return np.where(in_bowl, far, depth)


def test_votes_match_projected_cells() -> None:
    cameras = views()[:5]
    hull = ball()
    depths = [bowl_depth(c).astype(np.float32) for c in cameras]
    air, surface = count_votes(hull, cameras, depths)
    rng = np.random.default_rng(1)
    inside = np.argwhere(hull.field < 0)
    for cell in inside[rng.choice(len(inside), 200, replace=False)]:
        point = hull.lower + (cell + 0.5) * hull.cell
        gaps = []
        for camera, depth in zip(cameras, depths, strict=True):
            pixel, z = camera.project(point[None])
            u, v = np.floor(pixel[0]).astype(int)
            if 0 <= u < camera.width and 0 <= v < camera.height and depth[v, u] > 0:
                gaps.append(depth[v, u] - z[0])
        sure = np.abs(np.abs(gaps) - hull.cell / 2) > 1e-4  # not decided by rounding
        if sure.all():
            assert air[tuple(cell)] == sum(g > hull.cell / 2 for g in gaps)
            assert surface[tuple(cell)] == sum(abs(g) <= hull.cell / 2 for g in gaps)


def test_only_the_bowl_is_carved() -> None:
    hull, cameras = ball(), views()
    opened = carve_hull(hull, cameras, [bowl_depth(c).astype(np.float32) for c in cameras], ball_softness(hull))
    axis = hull.lower[0] + (np.arange(CELLS) + 0.5) * hull.cell
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    solid, in_bowl = hull.field < 0, HOLLOW - np.linalg.norm(cells - BOWL, axis=-1)
    now = opened.hull.occupancy
    assert opened.carved_regions == 1 and opened.share == pytest.approx((solid & (in_bowl > 0)).sum() / solid.sum(), rel=0.4)
    assert not now[solid & (in_bowl > 1.5 * hull.cell)].any()  # free space, 1.5 cells from the wall
    assert now[solid & (in_bowl < -1.5 * hull.cell)].all()  # nothing carved elsewhere
    # The new surface is up to a cell before the wall, with the same orientation.
    points, normals = opened.hull.surface_points(4000, 0)
    floor = np.linalg.norm(points - BOWL, axis=1) < HOLLOW + hull.cell
    floor &= np.linalg.norm(points, axis=1) < RADIUS - 2 * hull.cell
    assert floor.sum() > 60
    off = np.linalg.norm(points[floor] - BOWL, axis=1) - HOLLOW
    assert -hull.cell < off.mean() < 0
    towards = (BOWL - points[floor]) / np.linalg.norm(BOWL - points[floor], axis=1, keepdims=True)
    assert (normals[floor] * towards).sum(1).mean() > 0.9


def test_free_cells_join_the_region_beside_them() -> None:
    """The lower half of the bowl joins the upper one; a pocket elsewhere does not, nor what would take a side of the ball away."""
    hull, cameras = ball(), views()
    axis = hull.lower[0] + (np.arange(CELLS) + 0.5) * hull.cell
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    solid, in_bowl = hull.field < 0, np.linalg.norm(cells - BOWL, axis=-1) < HOLLOW
    bowl, upper = solid & in_bowl, cells[..., 0] > BOWL[0] - 0.85 * HOLLOW
    carved, lower = bowl & upper, bowl & ~upper
    assert carved.sum() > 100 and lower.sum() > 20
    share = np.where(lower | (np.linalg.norm(cells - np.array([-0.1, 0.2, 0.0]), axis=-1) < 0.1), 0.9, 0.1).astype(np.float32)
    grown = _grow(carved, share, hull, cameras)
    assert grown[lower].mean() > 0.8 and not grown[~lower].any()
    share = np.where(solid & (cells[..., 2] > 0.1), 0.9, 0.1).astype(np.float32)
    assert not _grow(carved, share, hull, cameras).any()


def test_mirror_images_are_not_carved() -> None:
    # Reflections on a specular ball match behind its surface, at a different location in every view.
    rng = np.random.default_rng(5)
    hull, cameras = ball(), views()
    depths = [np.where(d > 0, d + rng.uniform(0.1, 0.6), 0).astype(np.float32) for d in map(sphere_depth, cameras)]
    opened = carve_hull(hull, cameras, depths, ball_softness(hull))
    assert opened.carved_regions == 0 and opened.unsupported_regions >= 1 and opened.share == 0
    assert opened.hull is hull


def test_silhouette_violations_are_not_carved() -> None:
    # A consistent mirror image: a smaller ball inside the ball. All depths agree with it, only silhouettes do not.
    hull, cameras = ball(), views()
    smaller = [Camera(**{**vars(c), "t": c.t / 0.8}) for c in cameras]
    depths = [(0.8 * sphere_depth(c)).astype(np.float32) for c in smaller]
    opened = carve_hull(hull, cameras, depths, np.full(hull.field.shape, 2 * SOFT, np.float32))
    assert opened.carved_regions == 0 and opened.silhouette_violations >= 1 and opened.hull is hull
    # Where the ball's surface is hard the depths are mirror images.
    opened = carve_hull(hull, cameras, depths, np.full(hull.field.shape, 0.9 * SOFT, np.float32))
    assert opened.carved_regions == 0 and opened.hull is hull


def test_mirror_images_around_a_bowl_do_not_spoil_it() -> None:
    # Around the bowl all depths lie behind the surface, as in the mirror image of a smaller ball.
    hull, cameras = ball(), views()
    depths = []
    for camera in cameras:
        whole, mirrored = sphere_depth(camera), 0.8 * sphere_depth(Camera(**{**vars(camera), "t": camera.t / 0.8}))
        entry = camera.centre + whole[..., None] * camera.rays()
        around = (whole > 0) & (np.linalg.norm(entry - BOWL, axis=-1) < 0.75)
        depths.append(np.where(around, np.maximum(bowl_depth(camera), mirrored), whole).astype(np.float32))
    opened = carve_hull(hull, cameras, depths, ball_softness(hull))
    axis = hull.lower[0] + (np.arange(CELLS) + 0.5) * hull.cell
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    solid, in_bowl = hull.field < 0, HOLLOW - np.linalg.norm(cells - BOWL, axis=-1)
    assert opened.carved_regions == 1
    assert not opened.hull.occupancy[solid & (in_bowl > 2 * hull.cell)].any()
    assert opened.hull.occupancy[solid & (in_bowl < -(2 * SOFT_BORDER + 1) * hull.cell)].all()
    # If all could be air, the bowl would be one region with what violates silhouettes.
    opened = carve_hull(hull, cameras, depths, np.full(hull.field.shape, 2 * SOFT, np.float32))
    assert opened.silhouette_violations == 1 and opened.hull is hull


def test_what_remains_of_a_region_must_open_widely() -> None:
    """A pocket behind a narrow hole is as good as a bowl, unless it is what is left of a region that violates silhouettes."""
    hull = ball()
    axis = hull.lower[0] + (np.arange(CELLS) + 0.5) * hull.cell
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    solid, none = hull.field < 0, np.zeros(hull.field.shape, np.float32)
    soft, hard = (np.full(hull.field.shape, k * SOFT, np.float32) for k in (2.0, 0.5))
    bowl = solid & (np.linalg.norm(cells - BOWL, axis=-1) < HOLLOW)
    hole = (np.abs(cells[..., 1:]).max(-1) < 1.6 * hull.cell) & (cells[..., 0] > 0.3)
    pocket = solid & ((np.linalg.norm(cells - (0.15, 0, 0), axis=-1) < 0.35) | hole)
    for free, remains in ((bowl, True), (pocket, False)):
        for limits, votes, softness, kept in (
            (REMAINDER, none, soft, remains),
            (REMAINDER, none, hard, False),
            (REGION, none + 1, soft, True),
            (REGION, none, soft, False),
            (REGION, none + 1, hard, False),
        ):
            label, keep, refused = _carvable_regions(free, solid, votes, softness, limits)
            assert label.max() == 1 and keep.tolist() == [False, kept] and refused == (not kept)


def test_few_votes_need_a_softer_opening() -> None:
    """Depths behind a glossy front vote for few surfaces, and open through a front that is soft here and there."""
    hull = ball()
    axis = hull.lower[0] + (np.arange(CELLS) + 0.5) * hull.cell
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    solid = hull.field < 0
    bowl = solid & (np.linalg.norm(cells - BOWL, axis=-1) < HOLLOW)
    some, half = np.random.default_rng(0).random(hull.field.shape) < 0.2, cells[..., 1] > 0
    for soft, votes, kept in ((some, 0.08, False), (some, 0.2, True), (half, 0.08, True), (half, 0.03, False)):
        softness = np.where(soft, 2 * SOFT, 0.5 * SOFT).astype(np.float32)
        _, keep, _ = _carvable_regions(bowl, solid, np.full(hull.field.shape, votes, np.float32), softness, REGION)
        assert keep.tolist() == [False, kept]


def test_rays_are_empty_without_remaining_cells() -> None:
    hull = ball()
    middle = np.array([[CELLS // 2, CELLS // 2, CELLS // 2]])
    camera = camera_at(np.array([3.0, 0, 0]), "a", 110, 95)
    left = np.zeros(hull.field.shape, bool)
    assert count_empty_rays(middle, left, hull, [camera, camera]).tolist() == [2]
    for along in (5, CELLS - 5):  # before and behind the cell
        left[:] = False
        left[along, CELLS // 2 - 1 : CELLS // 2 + 2, CELLS // 2 - 1 : CELLS // 2 + 2] = True
        assert count_empty_rays(middle, left, hull, [camera]).tolist() == [0]
    left[:] = False
    left[:, : CELLS // 2 - 4] = True  # beside the ray
    assert count_empty_rays(middle, left, hull, [camera]).tolist() == [1]
    away = camera_at(np.array([3.0, 0, 0]), "b", 4, 4)
    assert count_empty_rays(np.array([[CELLS // 2, 0, 0]]), left, hull, [away]).tolist() == [0]  # outside the frame: unknown


def test_hull_is_unchanged_without_depths() -> None:
    hull = ball()
    soft = np.full(hull.field.shape, 9.0, np.float32)
    assert carve_hull(hull, [], [], soft).hull is hull
    cameras = views()
    assert carve_hull(hull, cameras, [np.zeros((c.height, c.width), np.float32) for c in cameras], soft).share == 0


def test_depths_of_selected_planes() -> None:
    camera = camera_at(np.array([3.0, 0, 0]), "a", 4, 1)
    plane = np.zeros((1, 4, 3), np.float32)
    plane[..., 2] = [0.5, 0.5, 0.25, 0.0]
    assert z_depth(camera, plane, np.array([[False, True, True, True]])).tolist() == [[0.0, 2.0, 4.0, 0.0]]


def test_hull_round_trip(tmp_path: Path) -> None:
    hull = ball()
    hull.save(tmp_path / "hull.npz")
    again = Hull.load(tmp_path / "hull.npz")
    assert np.abs(again.field - hull.field).max() < 1e-3 and again.cell == hull.cell and (again.lower == hull.lower).all()
    assert (again.occupancy == hull.occupancy).all()
