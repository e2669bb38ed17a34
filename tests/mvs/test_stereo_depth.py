"""Stereo depths replace rendered depths where both show the same surface, at any size of the depth map."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.meshing.depth_views import DepthView
from gsbake.meshing.stereo_depth import MAX_WEIGHT_RATIO, MIN_OVERLAP, merge_stereo_depth, resample_depth
from tests.mvs.scenes import arc, plane_depth, sphere_depth


def test_resampling_is_exact_on_planes() -> None:
    camera = arc(1)[0]
    depth = plane_depth(camera).astype(np.float32)
    small = camera.scaled(130, 113)
    inverse, sure = resample_depth(depth, np.ones(depth.shape, np.float32), 130, 113, 0.05)
    np.testing.assert_allclose(1 / inverse[2:-2, 2:-2], plane_depth(small)[2:-2, 2:-2], rtol=2e-4)
    assert (sure == 1).all()


def test_discontinuities_and_holes_are_not_blurred() -> None:
    depth = np.full((40, 40), 2.0, np.float32)
    depth[:, 20:] = 3.0
    depth[:10] = 0
    inverse, sure = resample_depth(depth, (depth > 0).astype(np.float32), 33, 33, 0.02)
    np.testing.assert_allclose(np.unique(inverse.round(4)), [0, 0.3333, 0.5], atol=1e-6)
    assert ((inverse > 0) == (sure > 0)).all()


def test_only_consistent_depths_replace_rendered_ones() -> None:
    camera = arc(1)[0]
    truth = sphere_depth(camera).astype(np.float32)
    noisy = np.where(truth > 0, truth + 0.01 * np.sin(np.arange(truth.shape[1]))[None, :], 0).astype(np.float32)
    view = DepthView.from_depth(camera, noisy)
    measured, sure = truth.copy(), np.where(truth > 0, 1, 0).astype(np.float32)
    half = truth.shape[1] // 2
    measured[:, half:] += np.where(truth[:, half:] > 0, 0.2, 0).astype(np.float32)  # another surface
    out, share = merge_stereo_depth(view, measured, sure, 0.03)
    known = truth > 0
    left, right = known.copy(), known.copy()
    left[:, half - 2 :] = False
    right[:, : half + 2] = False
    np.testing.assert_allclose(1 / out.inverse[left], truth[left], rtol=1e-5)
    np.testing.assert_allclose(out.inverse[right], view.inverse[right], rtol=5e-3)  # all scaled by one factor
    np.testing.assert_allclose(out.weight[left], MAX_WEIGHT_RATIO * view.weight[left], rtol=1e-6)
    np.testing.assert_array_equal(out.weight[right], view.weight[right])
    assert share == pytest.approx(left.sum() / known.sum(), abs=0.03)
    assert np.ptp(out.inverse[right] / view.inverse[right]) < 1e-6
    unsure, share = merge_stereo_depth(view, measured, 0.1 * sure, 0.03)
    assert share == 0 and unsure.inverse is not None and (unsure.inverse == view.inverse).all()


@pytest.mark.parametrize("enough", [True, False])
def test_common_scale_error_of_rendered_depths_is_corrected(enough: bool) -> None:
    camera = arc(1)[0]
    truth = sphere_depth(camera).astype(np.float32)
    known = truth > 0
    view = DepthView.from_depth(camera, 1.004 * truth)
    met = known.copy()
    met[:, truth.shape[1] // 2 :] = False
    if not enough:
        met &= np.cumsum(met).reshape(met.shape) < MIN_OVERLAP / 2
    out, _ = merge_stereo_depth(view, np.where(met, truth, 0).astype(np.float32), met.astype(np.float32), 0.03)
    rest = known & ~met
    rest[:, : truth.shape[1] // 2 + 2] = False
    np.testing.assert_allclose(1 / out.inverse[rest], truth[rest] * (1 if enough else 1.004), rtol=1e-4)
