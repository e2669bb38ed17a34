"""Matching, consistency and fusion on photos of a known sphere: accuracy, masks, degenerate inputs, independence of threads."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.mvs.coarse_to_fine import find_planes
from gsbake.mvs.consistency import check_consistency
from gsbake.mvs.depth_bounds import depth_bounds, seed_depths
from gsbake.mvs.depth_maps import DepthMap, consistent_pixels, filter_depth_map, inverse_depth, matched_pixels, read_depth, rounded
from gsbake.mvs.fusion import fuse
from gsbake.mvs.outliers import find_outliers, without_points
from gsbake.mvs.point_cloud import StereoCloud
from tests.mvs.scenes import RADIUS, arc, sphere_depth, sphere_photos


def find(photos, i, seed=0, others=None):
    coarse = photos[i][0]
    bounds = depth_bounds(coarse.camera, coarse.inside, None)
    no_seeds = np.zeros(bounds[0].shape, np.float32)
    sources = [j for j in range(len(photos)) if j != i] if others is None else others
    return find_planes(photos[i], [photos[j] for j in sources], bounds, no_seeds, 2, seed)


@pytest.fixture(scope="module")
def scene():
    cameras = arc(5)
    photos = sphere_photos(cameras)
    return cameras, photos, [find(photos, i) for i in range(5)]


def test_depth_of_the_sphere(scene) -> None:
    cameras, photos, planes = scene
    for i in (1, 2, 3):
        truth = sphere_depth(cameras[i])
        depth = 1 / np.maximum(inverse_depth(cameras[i], planes[i].plane), 1e-6)
        sure = (planes[i].cost < 0.3) & (truth > 0)
        assert sure.sum() > 0.5 * (truth > 0).sum()
        assert np.median(np.abs(depth - truth)[sure]) < 0.004  # at a distance of 2.3: .2 pixels of disparity
        assert not (planes[i].cost[photos[i][-1].inside == 0] < 1).any()  # nothing outside the mask
        assert np.isfinite(planes[i].plane).all() and np.isfinite(planes[i].cost).all()


def test_maps_and_points_lie_on_the_sphere(scene, tmp_path) -> None:
    cameras, photos, planes = scene
    good = [matched_pixels(p.cost) for p in planes]
    asked = [[j for j in range(5) if j != i] for i in range(5)]
    others = [[(cameras[j], planes[j].plane, good[j]) for j in asked[i]] for i in range(5)]
    found = [check_consistency(cameras[i], planes[i].plane, good[i], others[i]) for i in range(5)]
    maps = [filter_depth_map(cameras[i], planes[i].cost, found[i], 2, None) for i in range(5)]
    cloud = fuse(maps, asked, lambda i: np.repeat(photos[i][-1].grey[..., None], 3, 2), lambda i: None)
    assert 500 < len(cloud) < sum(map(len, maps))  # without duplicates
    off = np.linalg.norm(cloud.points, axis=1) - RADIUS
    assert np.median(np.abs(off)) < 0.002 and np.quantile(np.abs(off), 0.95) < 0.012
    outward = (cloud.normals * cloud.points).sum(1) / np.linalg.norm(cloud.points, axis=1)
    assert np.median(outward) > 0.99
    assert (cloud.views >= 2).all() and (cloud.confidence > 0).all() and (cloud.radius > 0).all()
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)
    cloud.save(tmp_path / "points.ply")
    again = StereoCloud.load(tmp_path / "points.ply")
    np.testing.assert_allclose(again.points, cloud.points, atol=1e-6)
    np.testing.assert_array_equal(again.views, cloud.views)
    maps[2].save(tmp_path / "one.npz")
    depth, sure = read_depth(tmp_path / "one.npz")
    assert ((depth > 0) == (sure > 0)).all() and np.abs(depth - sphere_depth(cameras[2]))[depth > 0].mean() < 0.005
    assert (tmp_path / "one.npz").stat().st_size < 0.5 * (depth.nbytes + sure.nbytes / 2)  # what has no depth takes no room
    np.testing.assert_allclose(depth, maps[2].depth(), rtol=2**-15)
    np.testing.assert_allclose(sure.ravel()[maps[2].pixels], maps[2].confidence, atol=1 / 256)


def test_depths_on_disk_have_fourteen_bits() -> None:
    """Ties aside, the nearest multiple of 2^-14 of the power of two below."""
    values = np.array([0.0, 1.0, 1 + 0.6 * 2**-14, 1 + 0.4 * 2**-14, 7.9999, 3 + 1.2 * 2**-13], np.float32)
    np.testing.assert_array_equal(rounded(values), np.array([0, 1, 1 + 2**-14, 1, 8, 3 + 2**-13], np.float32))


def test_averaging_consistent_views_reduces_the_error(scene) -> None:
    cameras, _, planes = scene
    good = [matched_pixels(p.cost) for p in planes]
    found = check_consistency(cameras[2], planes[2].plane, good[2], [(cameras[j], planes[j].plane, good[j]) for j in (0, 1, 3, 4)])
    own, truth = filter_depth_map(cameras[2], planes[2].cost, found, 1, None).depth(), sphere_depth(cameras[2])
    sure = (found.consistent >= 3) & (own > 0)
    alone = 1 / inverse_depth(cameras[2], planes[2].plane)[sure]
    assert sure.sum() > 10_000 and np.abs(own - truth)[sure].mean() < np.abs(alone - truth[sure]).mean()


def test_free_space_violations(scene) -> None:
    """A patch moved 10 % towards its camera: other views see the sphere behind it."""
    cameras, _, planes = scene
    moved = planes[2].plane.copy()
    moved[55:65, 65:75] *= 1.1
    good = [matched_pixels(p.cost) for p in planes]
    found = check_consistency(cameras[2], moved, good[2], [(cameras[j], planes[j].plane, good[j]) for j in (1, 3)])
    patch = found.violations[56:64, 66:74]
    assert np.median(patch) >= 1 and not consistent_pixels(found, 1)[56:64, 66:74].any()
    assert np.median(found.violations[good[2] > 0]) == 0


def test_no_depths_without_source_views() -> None:
    photos = sphere_photos(arc(1))
    planes = find(photos, 0)
    assert (planes.cost == 1).all() and not planes.plane.any()
    found = check_consistency(photos[0][-1].camera, planes.plane, matched_pixels(planes.cost), [])
    assert not filter_depth_map(photos[0][-1].camera, planes.cost, found, 1, None).confidence.any()


def test_no_depths_without_texture() -> None:
    photos = sphere_photos(arc(3), flat=True)
    planes = find(photos, 1)
    assert (matched_pixels(planes.cost) > 0).mean() < 0.02 and np.isfinite(planes.plane).all()


def test_planes_do_not_depend_on_threads(scene) -> None:
    from concurrent.futures import ThreadPoolExecutor

    _, photos, planes = scene
    with ThreadPoolExecutor(2) as pool:
        again = list(pool.map(lambda i: find(photos, i), range(3)))
    for a, b in zip(again, planes, strict=False):
        np.testing.assert_array_equal(a.plane, b.plane)
        np.testing.assert_array_equal(a.cost, b.cost)


def test_bounds_contain_the_surface() -> None:
    camera = arc(1)[0]
    truth = sphere_depth(camera)
    low, high = depth_bounds(camera, (truth > 0).astype(np.uint8), None)
    hit = truth > 0
    assert (low[hit] < 1 / truth[hit]).all() and (1 / truth[hit] < high[hit]).all() and not high[~hit].any()


def test_hull_bounds_are_tighter() -> None:
    from gsbake.capture.hull.visual_hull import Hull

    cameras = [*arc(5, 30), *arc(5, 70)]
    masks = [((sphere_depth(c) > 0) * 255).astype(np.uint8) for c in cameras]
    hull = Hull.from_masks(cameras, masks, np.zeros(3), 1.0, 64)
    camera, truth = cameras[2], sphere_depth(cameras[2])
    inside = (truth > 0).astype(np.uint8)
    low, high = depth_bounds(camera, inside, hull)
    ball = depth_bounds(camera, inside, None)
    deep = truth > 0
    deep[:-1] &= deep[1:]
    assert (high[deep] > 0).mean() > 0.97
    held = deep & (high > 0)
    assert (1 / truth[held] <= high[held] * 1.01).mean() > 0.99 and (1 / truth[held] >= low[held]).mean() > 0.99
    assert (high[held] < ball[1][held]).mean() > 0.95


def test_seed_is_the_nearest_point() -> None:
    camera = arc(1)[0]
    middle = camera.centre + 2.0 * camera.rays()[60, 70]
    behind = camera.centre + 2.6 * camera.rays()[60, 70]
    seeds = seed_depths(camera, np.stack([behind, middle]), 3)
    assert seeds[60, 70] == pytest.approx(0.5, rel=1e-5) and seeds[62, 70] == pytest.approx(0.5, rel=1e-5)
    assert seeds[66, 70] == 0 and not seed_depths(camera, np.zeros((0, 3)), 3).any()


def test_isolated_component_deep_inside_the_hull_is_removed(scene) -> None:
    """A mirror image: a patch of depths far behind the surface. The surface itself stays."""
    from gsbake.capture.hull.visual_hull import Hull

    cameras, _, _ = scene
    truth = sphere_depth(cameras[2]).astype(np.float32)
    depth = truth.copy()
    depth[90:100, 100:112] = truth[90:100, 100:112] + 0.5
    plane = np.zeros((*depth.shape, 3), np.float32)
    plane[..., 2] = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
    sure, views = (depth > 0).astype(np.float32), (depth > 0).astype(np.uint8) * 3
    one = DepthMap.of(cameras[2], plane, sure, views)
    cloud = fuse([one], [[]], lambda i: np.zeros((*depth.shape, 3), np.uint8), lambda i: None)
    n = 44
    grid = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) * 2.2 / n - 1.1] * 3, indexing="ij"), -1)
    field = (np.linalg.norm(grid, axis=-1) - RADIUS).astype(np.float32)
    hull = Hull(field < 0, np.full(3, -1.1), 2.2 / n, field)
    outliers = find_outliers(cloud, hull)
    kept = without_points(one, outliers.contains)
    assert 120 <= outliers.points < 126 and (kept.depth()[90:100, 100:112] == 0).all()
    assert len(kept) == (depth > 0).sum() - outliers.points
    assert find_outliers(cloud, None).points < 6  # without a hull only tiny components are removed
