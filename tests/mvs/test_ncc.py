"""Matching cost: the homography against projected points, the kernels against the NumPy reference."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.ncc import OUT_OF_VIEW_COST, RADIUS, SamplingPattern, ncc_cost, pack_2x2, patch_statistics
from gsbake.mvs.ncc_reference import homography, ncc_cost_reference, offsets
from gsbake.mvs.pyramids import MatchingViews, relative_pose
from tests.mvs.scenes import arc, camera_at, photo, plane_depth

NORMAL, DISTANCE = np.array([1, 0.3, -0.2]), 0.2


def in_camera(camera: Camera, normal: Array = NORMAL, distance: float = DISTANCE) -> tuple[Array, float]:
    """The world plane in the camera's frame: R X + t = X'."""
    turned = camera.R @ normal
    return turned, distance + turned @ camera.t


def test_homography_maps_projected_points() -> None:
    first, second = camera_at(np.array([2.5, -0.8, 0.9]), "a"), camera_at(np.array([2.6, 0.7, 0.2]), "b", 100, 90)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (50, 3))
    points += ((DISTANCE - points @ NORMAL) / (NORMAL @ NORMAL))[:, None] * NORMAL
    a, _ = first.project(points)
    b, _ = second.project(points)
    mapped = np.c_[a, np.ones(50)] @ homography(first, second, *in_camera(first)).T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], b, atol=1e-9)


def test_relative_pose() -> None:
    first, second = arc(2)
    rotation, translation = relative_pose(first, second)
    points = np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose((points @ first.R.T + first.t) @ rotation.T + translation, points @ second.R.T + second.t, atol=1e-12)


def test_pattern_matches_the_reference() -> None:
    pattern = SamplingPattern.make()
    np.testing.assert_array_equal(np.stack([pattern.du, pattern.dv], 1), offsets())
    assert np.abs(offsets()).max() == RADIUS and len(np.unique(offsets(), axis=0)) == len(offsets())


def test_packed_words_hold_four_neighbours() -> None:
    grey = np.random.default_rng(2).integers(0, 256, (5, 7), dtype=np.uint8)
    word = pack_2x2(grey)
    for shift, dv, du in ((0, 0, 0), (8, 0, 1), (16, 1, 0), (24, 1, 1)):
        np.testing.assert_array_equal((word[:-1, :-1] >> shift) & 255, grey[dv : 4 + dv, du : 6 + du])


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_kernel_matches_the_reference(tilt: float) -> None:
    """Also for planes off the surface, for patches cut by the mask and by the frame."""
    cameras = arc(2)
    photos = [photo(c, plane_depth(c)) for c in cameras]
    inside = photos[0].inside.copy()
    inside[:, :40] = 0
    cut = type(photos[0])(photos[0].camera, photos[0].grey, inside)
    pair = MatchingViews.of(cut, photos[1:])
    made = SamplingPattern.make()
    pattern, views = made.arrays, pair.sources
    normal, distance = in_camera(cameras[0], NORMAL + tilt * np.array([0, 1, 1]), DISTANCE - 0.1 * tilt)
    mapping = homography(cameras[0], cameras[1], normal, distance)
    plane = (normal / distance).astype(np.float32)
    weight, moment = np.zeros(len(made.du), np.float32), np.zeros(len(made.du), np.float32)
    intrinsics = pair.intrinsics
    compared = outside = 0
    for v, u in [
        (60, 70),
        (45, 42),
        (3, 60),
        (118, 100),
        (80, 41),
        (100, 138),
        (30, 90),
        (60, 2),
        (95, 216),
        (186, 110),
        (3, 216),
        (120, 215),
    ]:
        expected = ncc_cost_reference(cut.grey, inside > 0, (v, u), photos[1].grey, mapping) if inside[v, u] else None
        patch_statistics(pair.grey, pair.inside, v, u, pattern, weight, moment)
        x, y = (np.float32(u) - intrinsics[2]) / intrinsics[0], (np.float32(v) - intrinsics[3]) / intrinsics[1]
        found = ncc_cost(0, *plane, x, y, 1 / intrinsics[0], 1 / intrinsics[1], pattern, weight, moment, views)
        if not inside[v, u]:
            continue
        if expected is None:
            assert found == OUT_OF_VIEW_COST
            outside += 1
        else:
            assert found == pytest.approx(expected, abs=2e-3)
            assert weight.sum() == pytest.approx(1, abs=1e-5)
            compared += 1
    assert compared >= 3 and outside >= 1


def test_true_plane_has_the_lowest_cost() -> None:
    cameras = arc(2)
    photos = [photo(c, plane_depth(c)) for c in cameras]
    values = []
    for shift in (-0.06, -0.02, 0.0, 0.02, 0.06):
        mapping = homography(cameras[0], cameras[1], *in_camera(cameras[0], distance=DISTANCE + shift))
        values.append(ncc_cost_reference(photos[0].grey, photos[0].inside > 0, (60, 70), photos[1].grey, mapping))
    assert np.argmin(values) == 2 and values[2] < 0.05 < min(values[0], values[-1])
