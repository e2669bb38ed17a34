"""Completion of masks of a torus (whose hole is real) on a table in 24 cameras: wrong masks are detected by tie points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsbake.capture.masks.completion import complete_masks, excluded_points
from gsbake.geometry.cameras import Camera
from tests.capture.hull.test_visual_hull import ring

MIDDLE, TUBE = 0.5, 0.17
SIZE = 160


def distance(points: Any) -> Any:
    """Signed distance (n,) from the torus around the z axis."""
    return np.hypot(np.hypot(points[..., 0], points[..., 1]) - MIDDLE, points[..., 2]) - TUBE


def true_mask(camera: Camera) -> Any:
    """Silhouette (h, w) of the torus, by sphere tracing."""
    rays = camera.rays()
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    at = np.full(rays.shape[:2], 1.5)
    for _ in range(80):
        at += distance(camera.centre + at[..., None] * rays)
    return np.where((distance(camera.centre + at[..., None] * rays) < 1e-3) & (at < 6), 255, 0).astype(np.uint8)


@pytest.fixture(scope="module")
def scene() -> tuple[list[Camera], list[Any], Any]:
    cameras = ring(24, 3.0, np.zeros(3), size=SIZE, focal=SIZE * 1.6)
    rng = np.random.default_rng(2)
    a, b = rng.uniform(0, 2 * np.pi, (2, 1500))
    wide = MIDDLE + TUBE * np.cos(b)
    torus = np.stack([wide * np.cos(a), wide * np.sin(a), TUBE * np.sin(b)], 1)
    table = np.column_stack([rng.uniform(-1, 1, (1500, 2)), np.full(1500, -TUBE)])
    return cameras, [true_mask(c) for c in cameras], np.concatenate([torus, table])


def with_missing_disc(mask: Any, share: float) -> Any:
    """The mask without a disc around a pixel of the object."""
    rows, columns = np.nonzero(mask)
    middle = len(rows) // 3
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    return np.where((y - rows[middle]) ** 2 + (x - columns[middle]) ** 2 < (share * SIZE) ** 2, 0, mask).astype(np.uint8)


def test_correct_masks_are_unchanged(scene: Any) -> None:
    cameras, masks, points = scene
    assert complete_masks(cameras, masks, points) == []


def test_missing_part_is_completed_and_the_real_hole_stays(scene: Any) -> None:
    cameras, masks, points = scene
    wrong = list(masks)
    for index in (3, 14):
        wrong[index] = with_missing_disc(masks[index], 0.14)
        assert (masks[index] > 0).sum() - (wrong[index] > 0).sum() > 300
    completions = complete_masks(cameras, wrong, points)
    assert [m.index for m in completions] == [3, 14]
    for one in completions:
        truth = masks[one.index] > 0
        lost = truth & (wrong[one.index] == 0)
        assert one.points >= 10
        assert one.missing[lost].mean() > 0.9
        assert (one.missing & ~truth).sum() < 0.1 * lost.sum()  # neither the hole nor a boundary all around


def test_points_that_most_masks_exclude_are_background(scene: Any) -> None:
    cameras, masks, points = scene
    # Half of the points lie on the table, outside most masks: they mark no mask as wrong.
    assert not any(len(pixels) for pixels in excluded_points(cameras, masks, points))
    assert complete_masks(cameras, masks, points[1500:]) == []


def test_many_wrong_masks_are_not_completed(scene: Any) -> None:
    cameras, masks, points = scene
    wrong = [with_missing_disc(m, 0.14) if i % 3 == 0 else m for i, m in enumerate(masks)]
    assert complete_masks(cameras, wrong, points) == []
