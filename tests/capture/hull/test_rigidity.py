"""Silhouettes of a rigid object, of one with a part that moved between two rounds of photos, and of one with wrong masks."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.capture.hull.rigidity import left_out, moved_part
from gsbake.capture.hull.visual_hull import unit_hull
from gsbake.geometry.cameras import Camera
from gsbake.synth.capture import look_at

STILL, MOVED = (0.5, 0.0, 0.2), (0.0, 0.5, 0.2)


def silhouette(camera: Camera, ball: tuple[float, float, float]) -> np.ndarray:
    """The mask of a ball in the middle and a smaller one."""
    rays = camera.rays()
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    inside = np.zeros(rays.shape[:-1], bool)
    for centre, radius in (((0.0, 0.0, 0.0), 0.4), (ball, 0.2)):
        to = np.array(centre) - camera.centre
        along = rays @ to
        inside |= np.linalg.norm(to - along[..., None] * rays, axis=-1) < radius
    return np.where(inside, 255, 0).astype(np.uint8)


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    """Two rounds of eight cameras around the object, from two heights."""
    around = [(np.deg2rad(45 * k), height) for height in (0.4, 1.6) for k in range(8)]
    places = [np.array([3 * np.cos(a), 3 * np.sin(a), z]) for a, z in around]
    return [look_at(f"{k:02d}", place, np.zeros(3), 0.0, 300.0, (80.0, 80.0), 160) for k, place in enumerate(places)]


@pytest.fixture(scope="module")
def still(cameras: list[Camera]) -> list[np.ndarray]:
    """Masks of a rigid object."""
    return [silhouette(camera, STILL) for camera in cameras]


def test_the_hull_of_a_rigid_object_covers_its_silhouettes(cameras: list[Camera], still: list[np.ndarray]) -> None:
    hull = unit_hull(cameras, still)
    assert left_out(hull, cameras, still).max() < 0.001 and moved_part(hull, cameras, still) is None


def test_a_part_that_moved_is_found(cameras: list[Camera], still: list[np.ndarray]) -> None:
    masks = still[:8] + [silhouette(camera, MOVED) for camera in cameras[8:]]
    hull = unit_hull(cameras, masks)
    ball = (0.2 / 0.4) ** 2 / (1 + (0.2 / 0.4) ** 2)  # its share of the silhouette where neither hides the other
    assert 0.3 * ball < np.median(left_out(hull, cameras, masks)) < 1.2 * ball
    assert "A part has moved between photos" in str(moved_part(hull, cameras, masks))


def test_a_camera_in_the_object_sees_nothing_missing(cameras: list[Camera], still: list[np.ndarray]) -> None:
    """Its border of one cell is the whole photo."""
    inside = look_at("in", np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0, 300.0, (80.0, 80.0), 160)
    full = np.full((160, 160), 255, np.uint8)
    hull = unit_hull(cameras, still)
    assert left_out(hull, [*cameras, inside], [*still, full])[-1] == 0


def test_wrong_masks_are_no_motion(cameras: list[Camera], still: list[np.ndarray]) -> None:
    """Four of sixteen masks, in both groups, lack half the object: the hull leaves out much, but so do those of the groups."""
    masks = [mask.copy() for mask in still]
    for k in (1, 5, 9, 13):
        masks[k][:80] = 0
    hull = unit_hull(cameras, masks)
    assert np.median(left_out(hull, cameras, masks)) > 0.1 and moved_part(hull, cameras, masks) is None
