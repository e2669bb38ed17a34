"""Depths behind a hard part of a ball are mirror images; those in a bowl, and just below the surface, are not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.softness import SOFT
from gsbake.mvs.depth_maps import DepthMap
from gsbake.mvs.mirror_images import MIN_DEPTH, behind_hard_parts, without_mirror_images
from tests.mvs.scenes import sphere_depth
from tests.mvs.test_carving import BOWL, CELLS, HOLLOW, ball, bowl_depth, views


def softness() -> NDArray[np.float32]:
    """The bowl's opening soft, the rest of the ball hard."""
    axis = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return np.where(np.linalg.norm(cells - BOWL, axis=-1) < HOLLOW, 2 * SOFT, 0.5 * SOFT).astype(np.float32)


def test_only_depths_behind_hard_parts_are_mirror_images() -> None:
    hull, cameras = ball(), views()
    seen, whole = [bowl_depth(c) for c in cameras], [sphere_depth(c) for c in cameras]
    true = [np.where(d > 0, d + 0.4 * hull.cell, 0).astype(np.float32) for d in seen]
    assert not any(found.any() for found in behind_hard_parts(hull, softness(), cameras, true))
    mirrored = [np.where(d > 0, d + 0.3, 0).astype(np.float32) for d in whole]
    for camera, depth, surface, found in zip(
        cameras, mirrored, whole, behind_hard_parts(hull, softness(), cameras, mirrored), strict=True
    ):
        points = camera.centre + depth[..., None] * camera.rays()
        entry = camera.centre + surface[..., None] * camera.rays()
        inside = (depth > 0) & (hull.signed_distance(points).reshape(depth.shape) < -(MIN_DEPTH + 1) * hull.cell)
        hard = np.linalg.norm(entry - BOWL, axis=-1) > HOLLOW + 8 * hull.cell
        assert (inside & hard).sum() > 50 and found[inside & hard].all()
        assert not found[(depth > 0) & (np.linalg.norm(entry - BOWL, axis=-1) < HOLLOW - hull.cell)].any()
        assert not found[depth == 0].any()


def test_mirror_images_leave_the_depth_maps() -> None:
    hull, camera = ball(), views()[12]  # from behind, where all is hard
    surface = sphere_depth(camera)
    wrong = np.zeros(surface.shape, bool)
    wrong[40:50, 50:60] = True
    depth = np.where(wrong, surface + 0.3, surface)
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    plane = np.stack([0 * inverse, 0 * inverse, inverse], -1).astype(np.float32)
    covered = surface > 0
    one = DepthMap.of(camera, plane, covered.astype(np.float32), 2 * covered.astype(np.uint8))
    (kept,), share = without_mirror_images([one], hull, softness())
    assert share == wrong.sum() / covered.sum()
    np.testing.assert_array_equal(kept.pixels, np.flatnonzero(covered & ~wrong))
    assert (kept.confidence == 1).all() and (kept.views == 2).all()
    assert list(behind_hard_parts(hull, softness(), [], [])) == []
