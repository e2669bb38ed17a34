"""Visual hull and unit frame of a ball with known cameras: all expected values have a closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.hull.visual_hull import Hull, carve, silhouette_distance, visual_hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.poses.normalisation import UNIT_RADIUS, bounding_sphere_from_masks, bounding_sphere_from_views, nearest_point_to_axes
from gsbake.capture.poses.up_axis import up_direction, upright_rotation
from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from tests.support.cameras import look_at

CENTRE, RADIUS = np.array([1.0, -2.0, 0.5]), 0.6


def ring(count: int = 24, distance: float = 3.0, target: np.ndarray[Any, Any] = CENTRE, **kw: Any) -> list[Camera]:
    cameras = []
    for i in range(count):
        a, h = 2 * np.pi * i / count * 3, np.radians(-35 + 110 * i / count)
        eye = target + distance * np.array([np.cos(a) * np.cos(h), np.sin(a) * np.cos(h), np.sin(h)])
        cameras.append(look_at(eye, target, name=f"c{i:02d}", **kw))
    return cameras


def ball_mask(camera: Camera) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Silhouette of the ball: rays closer to its centre than its radius."""
    rays = camera.rays()
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = CENTRE - camera.centre
    along = rays @ offset
    near = np.linalg.norm(offset - along[..., None] * rays, axis=-1)
    return np.where((near < RADIUS) & (along > 0), 255, 0).astype(np.uint8)


def test_ball() -> None:
    cameras = ring()
    hull = Hull.from_masks(cameras, [ball_mask(c) for c in cameras], CENTRE + 0.1, 1.0, 64)
    assert hull.occupancy.shape == (64, 64, 64) and hull.cell == pytest.approx(2 / 64)
    volume = hull.occupancy.sum() * hull.cell**3
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.08)
    points, normals = hull.surface_points(3000, seed=1)
    outward = points - CENTRE
    distance = np.linalg.norm(outward, axis=1)
    assert np.median(distance) == pytest.approx(RADIUS, abs=0.2 * hull.cell)
    assert np.quantile(np.abs(distance - RADIUS), 0.95) < 1.5 * hull.cell
    assert np.median(np.einsum("ni,ni->n", normals, outward / distance[:, None])) > 0.98
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(3000))
    # Evenly spread: an eighth of the points per octant.
    octant = (outward > 0) @ [1, 2, 4]
    assert np.bincount(octant, minlength=8) == pytest.approx(np.full(8, 375), abs=60)
    again, _ = hull.surface_points(3000, seed=1)
    assert (again == points).all()


def test_signed_distance_of_the_ball() -> None:
    cameras = ring()
    hull = Hull.from_masks(cameras, [ball_mask(c) for c in cameras], CENTRE, 1.0, 64)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for radius in (0.3, 0.5, 0.7):
        found = hull.signed_distance(CENTRE + radius * directions)
        assert np.median(found) == pytest.approx(radius - RADIUS, abs=0.05)
    assert (hull.signed_distance(CENTRE + 5 * directions) > 3).all()


def test_silhouette_distance_is_zero_on_the_edge() -> None:
    mask = np.zeros((9, 20), np.uint8)
    mask[:, 10:] = 255
    assert silhouette_distance(mask)[4, 8:12].tolist() == [1.5, 0.5, -0.5, -1.5]
    assert (silhouette_distance(np.full((3, 4), 255, np.uint8)) == -5).all()


def test_outside_the_frame_is_unknown_not_empty() -> None:
    """Cameras whose frames cut the ball in half leave it whole as long as others see the rest."""
    cameras = ring(24)
    aside = [look_at(c.centre, CENTRE + np.array([0.9, 0.0, 0.0])) for c in ring(10, focal=300)]
    aside = [replace(c, fx=420.0, fy=420.0) for c in aside]
    masks = [ball_mask(c) for c in [*cameras, *aside]]
    assert any(m[0].any() or m[-1].any() or m[:, 0].any() or m[:, -1].any() for m in masks[24:])
    hull = Hull.from_masks([*cameras, *aside], masks, CENTRE, 1.0, 48)
    assert hull.occupancy.sum() * hull.cell**3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.1)


def test_one_wrong_mask_is_tolerated_but_not_three() -> None:
    cameras = ring(24)
    masks = [ball_mask(c) for c in cameras]
    masks[5] = np.zeros_like(masks[5])
    whole = Hull.from_masks(cameras, masks, CENTRE, 1.0, 32)
    assert whole.occupancy.sum() * whole.cell**3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.2)
    masks[6] = masks[7] = np.zeros_like(masks[5])
    assert Hull.from_masks(cameras, masks, CENTRE, 1.0, 32).empty
    with pytest.raises(ValueError, match="empty"):
        Hull.from_masks(cameras, masks, CENTRE, 1.0, 32).surface_points(10, 0)


def test_points_that_no_view_sees_are_outside() -> None:
    cameras = ring(12, focal=1000)  # a narrow field of view on the ball's centre
    field = carve(cameras, [np.full((160, 160), 255, np.uint8)] * 12, CENTRE, 3.0, 24)
    assert field[12, 12, 12] < 0 and field[0, 0, 0] > 0 and field[-1, 12, 12] > 0


def test_extent_of_masked_photos() -> None:
    cameras = ring(24)
    extent = bounding_sphere_from_masks(cameras, [ball_mask(c) for c in cameras])
    assert extent is not None
    assert extent.centre == pytest.approx(CENTRE, abs=0.03) and extent.radius == pytest.approx(RADIUS, rel=0.06)
    unit = extent.similarity().inverse()
    assert np.linalg.norm(unit.apply(CENTRE)) < 0.05
    assert extent.similarity().scale == pytest.approx(extent.radius / UNIT_RADIUS)
    assert bounding_sphere_from_masks(cameras, [np.zeros((160, 160), np.uint8)] * 24) is None


def test_extent_without_masks() -> None:
    cameras = ring(24)
    assert nearest_point_to_axes(cameras) == pytest.approx(CENTRE, abs=1e-6)
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3))
    ball = CENTRE + RADIUS * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    walls = CENTRE + rng.uniform(-9, 9, (500, 3))
    extent = bounding_sphere_from_views(cameras, np.concatenate([ball, walls]))
    assert extent.centre == pytest.approx(CENTRE, abs=0.1) and 0.9 * RADIUS < extent.radius < 1.4 * RADIUS
    blind = bounding_sphere_from_views(cameras, None)
    assert blind.centre == pytest.approx(CENTRE, abs=1e-6)
    # The frame's half angle, atan(80/200), at distance 3 shows a radius of 1.2.
    assert blind.radius == pytest.approx(0.85 * 1.2, rel=1e-6)
    outlier = look_at(np.array([50.0, 0, 0]), np.array([50.0, 50.0, 0.1]))
    assert nearest_point_to_axes([*cameras, outlier]) == pytest.approx(CENTRE, abs=0.1)


def test_up_is_vertical_when_all_cameras_look_down_from_one_side() -> None:
    rng = np.random.default_rng(3)
    cameras = []
    for angle in np.linspace(-0.9, 0.9, 15):
        eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 4.0])
        cameras.append(look_at(eye, np.zeros(3), roll=rng.normal(0, 0.02)))
    turned = np.asarray(cv2.Rodrigues(np.array([0.4, -0.8, 0.3]))[0])
    up = up_direction([c.R @ turned.T for c in cameras])
    assert up @ turned[:, 2] > np.cos(np.radians(2))  # the mean of the cameras' ups would lean by 40°
    assert upright_rotation(up) @ up == pytest.approx([0, 0, 1])
    assert np.linalg.det(upright_rotation(up)) == pytest.approx(1)
    assert upright_rotation(np.array([0, 0, -1.0])) @ (0, 0, -1) == pytest.approx([0, 0, 1])
    same_up = up_direction([cameras[0].R] * 3)
    assert same_up == pytest.approx(-cameras[0].R[1])


def test_visual_hull_of_a_poses_folder(tmp_path: Path) -> None:
    unit = Similarity(RADIUS / 0.9, np.eye(3), CENTRE)
    cameras = ring(16)
    (tmp_path / "masks").mkdir()
    for camera in cameras[1:]:
        cv2.imwrite(str(tmp_path / "masks" / f"{camera.name}.png"), ball_mask(camera))
    CameraSet(tuple(c.moved(unit.inverse()) for c in cameras), unit).save(tmp_path / "cameras.json")
    posed = PosedPhotos.open(tmp_path)
    with pytest.raises(ValueError, match="c00"):
        visual_hull(posed, 32)
    cv2.imwrite(str(tmp_path / "masks" / "c00.png"), ball_mask(cameras[0]))
    hull = visual_hull(posed, 48)
    points, _ = hull.surface_points(500, 0)
    assert np.median(np.linalg.norm(points, axis=1)) == pytest.approx(0.9, abs=0.02)
    assert hull.lower.tolist() == [-1, -1, -1]


def test_what_few_frames_hold_is_outside_unless_asked_for() -> None:
    """Close-ups show the middle of the ball, four photos all of it: its rim is in few frames."""
    whole, close = ring(4), [replace(c, name=f"n{c.name}", fx=14 * c.fx, fy=14 * c.fy) for c in ring(24)]
    cameras = [*whole, *close]
    masks = [ball_mask(c) for c in cameras]
    assert all((mask > 127).all() for mask in masks[4:])
    rim = Hull.from_masks(cameras, masks, CENTRE, 1.0, 64, min_visible_share=0.0).occupancy.sum()
    middle = Hull.from_masks(cameras, masks, CENTRE, 1.0, 64).occupancy.sum()
    assert middle * (2 / 64) ** 3 < 0.25 * 4 / 3 * np.pi * RADIUS**3 < rim * (2 / 64) ** 3
