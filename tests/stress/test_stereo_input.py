"""Stereo, hull and carving on hostile captures: finite files, or a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsbake.capture.hull.softness import surface_softness
from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Stereo
from gsbake.errors import GsbakeError
from gsbake.mvs.carving import carve_hull
from gsbake.mvs.depth_bounds import depth_bounds, seed_depths
from gsbake.mvs.depth_maps import read_depth
from gsbake.mvs.initial_points import initial_points
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.mvs.stereo import run_stereo
from gsbake.mvs.view_selection import select_views
from tests.stress.captures import CAMERAS, MASKS, PHOTOS, SIZE, around, masks, photos, write

OPTIONS = Stereo(enabled="always")
#: Every kind of cameras, photos and masks with plain others.
CASES = [
    *((cameras, "noise", "disc") for cameras in CAMERAS),
    *(("plain", kind, "disc") for kind in PHOTOS[1:]),
    *(("plain", "noise", kind) for kind in MASKS[1:]),
]
#: The one of each kind that runs with the quick tests.
QUICK = {("inside the object", "noise", "disc"), ("plain", PHOTOS[1], "disc"), ("plain", "noise", MASKS[1])}


def check(folder: Path, cameras: str, pictures: str, outlines: str) -> None:
    views = CAMERAS[cameras]()
    poses = write(folder / "poses", views, photos(pictures, len(views)), masks(outlines, len(views)))
    out = folder / "out"
    out.mkdir()
    try:
        results = run_stereo(poses, out, OPTIONS, threads=2, scratch=folder / "scratch")
    except GsbakeError as error:
        assert len(str(error)) > 20
        return
    assert np.isfinite([value for value in results.values() if isinstance(value, float | int)]).all()
    cloud = StereoCloud.load(out / "points.ply")
    for array in (cloud.points, cloud.normals, cloud.confidence):
        assert np.isfinite(array).all()
    assert len(cloud) == 0 or np.linalg.norm(cloud.points, axis=1).max() < 1.2
    for camera in views:
        depth, confidence = read_depth(out / "depth" / f"{camera.name}.npz")
        assert np.isfinite(depth).all() and (depth >= 0).all() and np.isfinite(confidence).all() and (confidence >= 0).all()
    if (out / "hull.npz").exists():
        hull = Hull.load(out / "hull.npz")
        assert np.isfinite(hull.field).all() and hull.cell > 0
    initial = initial_points(PosedPhotos.open(poses), out, 200, 0)
    assert initial is None or (np.isfinite(initial.points).all() and np.isfinite(initial.normals).all())


@pytest.mark.parametrize(
    ("cameras", "pictures", "outlines"), [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES]
)
def test_stereo_is_finite(tmp_path: Path, cameras: str, pictures: str, outlines: str) -> None:
    check(tmp_path, cameras, pictures, outlines)


@pytest.mark.stress
@pytest.mark.parametrize("outlines", MASKS)
@pytest.mark.parametrize("pictures", PHOTOS)
@pytest.mark.parametrize("cameras", CAMERAS)
def test_every_combination_is_finite(tmp_path: Path, cameras: str, pictures: str, outlines: str) -> None:
    check(tmp_path, cameras, pictures, outlines)


def ball(cells: int = 24) -> Hull:
    cell = 2 / cells
    axis = (np.arange(cells) + 0.5) * cell - 1
    field = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij")), axis=0) - 0.7
    return Hull(field < 0, np.full(3, -1.0), cell, field.astype(np.float32))


@pytest.mark.parametrize("depth", [np.nan, np.inf, -1.0, 0.0, 1e-30, 1e30, 3.0])
@pytest.mark.parametrize("cameras", CAMERAS)
def test_carving_with_hostile_depths(cameras: str, depth: float) -> None:
    hull, views = ball(), CAMERAS[cameras]()
    softness = surface_softness(hull, views, [np.full((SIZE, SIZE), 255, np.uint8)] * len(views))
    assert np.isfinite(softness).all() and softness.min() > 0
    carved = carve_hull(hull, views, [np.full((SIZE, SIZE), depth, np.float32)] * len(views), softness)
    assert np.isfinite(carved.hull.field).all() and 0 <= carved.share <= 1
    assert carved.hull.occupancy.any() and not (carved.hull.occupancy & ~hull.occupancy).any()


@pytest.mark.parametrize("inside", [False, True])
def test_carving_of_an_empty_and_of_a_full_grid(inside: bool) -> None:
    field = np.full((16, 16, 16), -0.1 if inside else 0.1, np.float32)
    hull = Hull(field < 0, np.full(3, -1.0), 0.125, field)
    views = around()
    softness = np.full(field.shape, 2.0, np.float32)
    carved = carve_hull(hull, views, [np.full((SIZE, SIZE), 10.0, np.float32)] * len(views), softness)
    assert carved.hull.occupancy.any() == inside and np.isfinite(carved.hull.field).all()


@pytest.mark.parametrize("cameras", CAMERAS)
def test_depth_bounds_and_view_selection(cameras: str) -> None:
    views, rng = CAMERAS[cameras](), np.random.default_rng(0)
    hostile = np.array([[0, 0, 0], views[0].centre, [1e30, 0, 0], [1e-30, 0, 0]])
    points = np.concatenate([rng.uniform(-1, 1, (50, 3)), hostile])
    normals = rng.normal(size=points.shape)
    for normal in (normals, np.zeros_like(normals), None):
        sources, checks = select_views(views, points, normal, 4, 8)
        assert all(i not in chosen for i, chosen in enumerate(sources)) and len(checks) == len(views)
    for camera in views:
        for hull in (None, ball()):
            low, high = depth_bounds(camera, np.ones((SIZE, SIZE), np.uint8), hull)
            assert np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all() and (low >= 0).all()
        assert np.isfinite(seed_depths(camera, points, 5)).all()
