"""Thin parts: a rod thinner than the hull's cells on a ball is found, and nothing without it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.hull.thin_parts import MIN_THIN_SHARE, find_thin_parts, load_thin_parts, thin_share
from gsbake.capture.hull.visual_hull import visual_hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from tests.capture.hull.test_visual_hull import ring
from tests.support.cameras import look_at

BALL, ROD, FROM, TO = 0.4, 0.006, 0.38, 0.9


def mask(camera: Camera, rod: bool) -> NDArray[np.uint8]:
    """Silhouette of a ball at the origin and a rod of radius ROD from it along +x."""
    rays = camera.rays().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eye = camera.centre
    near = np.linalg.norm(np.cross(rays, eye), axis=1) < BALL
    if rod:
        # Point on the rod's axis closest to the ray, within its length.
        slope = rays[:, 0]
        away = eye - rays * (rays @ eye)[:, None]
        at = (away[:, 0] / np.maximum(1 - slope**2, 1e-9)).clip(FROM, TO)
        near |= np.linalg.norm(np.cross(rays, eye - at[:, None] * np.array([1.0, 0, 0])), axis=1) < ROD
    return np.asarray(np.where(near, 255, 0), np.uint8).reshape(camera.height, camera.width)


def posed(folder: Path, rod: bool) -> PosedPhotos:
    cameras = [replace(c, name=f"c{k:02d}") for k, c in enumerate(ring(24, target=np.zeros(3), size=400, focal=549.0))]
    (folder / "masks").mkdir(parents=True)
    for camera in cameras:
        cv2.imwrite(str(folder / "masks" / f"{camera.name}.png"), mask(camera, rod))
    CameraSet(tuple(cameras), Similarity(1.0, np.eye(3), np.zeros(3))).save(folder / "cameras.json")
    return PosedPhotos.open(folder)


@pytest.fixture(scope="module")
def with_rod(tmp_path_factory: pytest.TempPathFactory) -> PosedPhotos:
    return posed(tmp_path_factory.mktemp("rod"), True)


def test_rod_that_the_hull_misses_is_found(with_rod: PosedPhotos, tmp_path: Path) -> None:
    hull = visual_hull(with_rod)
    axis = np.linspace(BALL + 0.02, TO - 0.02, 200)[:, None] * [1.0, 0, 0]
    assert (hull.signed_distance(axis) < 0).mean() < 0.7
    found = find_thin_parts(with_rod, hull, 40_000, 0)
    assert found.share > MIN_THIN_SHARE and len(found.points) > 50
    aside = np.linalg.norm(found.points[:, 1:], axis=1)
    assert aside.max() < 2 * ROD and found.points[:, 0].min() > BALL - 0.02
    outward: NDArray[Any] = (found.normals[:, 1:] * found.points[:, 1:]).sum(1)
    assert (outward > 0).mean() > 0.9
    found.save(tmp_path / "thin.npz")
    points, normals = load_thin_parts(tmp_path / "thin.npz")
    assert np.allclose(points, found.points, atol=1e-6) and np.allclose(normals, found.normals, atol=1e-6)


def test_share_of_the_masks_narrower_than_a_width(with_rod: PosedPhotos) -> None:
    rod, ball = 2 * ROD * (TO - BALL), np.pi * BALL**2  # areas seen from the side
    assert thin_share(with_rod, 0.02) == pytest.approx(0.8 * rod / (rod + ball), rel=0.4)  # a view along the rod sees less of it
    assert thin_share(with_rod, 0.004) < 0.2 * thin_share(with_rod, 0.02)


def test_ball_has_no_thin_parts(tmp_path: Path) -> None:
    smooth = posed(tmp_path / "ball", False)
    found = find_thin_parts(smooth, visual_hull(smooth), 40_000, 0)
    assert found.share < MIN_THIN_SHARE and found.points.shape == (0, 3)


def test_rod_is_visible_to_the_test_camera() -> None:
    camera = look_at(np.array([0.5, -3.0, 0.2]), np.zeros(3), size=400, focal=549.0)
    assert (mask(camera, True) > mask(camera, False)).sum() > 100
