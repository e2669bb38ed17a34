"""The stereo stage: files, skipping, resume after interruption, and initialisation of surfels from its results."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.hull.visual_hull import Hull, visual_hull
from gsbake.capture.photos.conversion import file_digest
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Profile, Stereo
from gsbake.errors import InterruptedRun
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.region import Region
from gsbake.mvs.depth_maps import read_depth
from gsbake.mvs.initial_points import in_free_space, initial_points, voxel_downsample
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.mvs.stereo import run_stereo
from gsbake.mvs.view_selection import select_views
from tests.mvs.scenes import RADIUS, arc, camera_at, photo, sphere_depth
from tests.support.recorder import Recorder

#: Half of the ring is dense enough for matching; the other photos only bound the hull.
CAMERAS = [
    *arc(5),
    *[camera_at(3.0 * np.array(d) / np.linalg.norm(d), f"far{i}") for i, d in enumerate([(-1, 0.4, 0.2), (-1, -0.8, -0.2), (0, 1, -1.2)])],
]


def run(poses: Path, out: Path, monitor: Recorder | None = None, scratch: Path | None = None, threads: int = 2, **settings: Any) -> Any:
    """The figures of one run."""
    out.mkdir()
    return run_stereo(poses, out, Stereo(**settings), threads=threads, scratch=scratch, monitor=monitor or Recorder())


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("capture") / "poses"
    for folder in ("photos", "masks"):
        (root / folder).mkdir(parents=True)
    CameraSet(tuple(CAMERAS)).save(root / "cameras.json")
    for camera in CAMERAS:
        seen = photo(camera, sphere_depth(camera))
        cv2.imwrite(str(root / "photos" / f"{camera.name}.png"), np.repeat(seen.grey[..., None], 3, 2))
        cv2.imwrite(str(root / "masks" / f"{camera.name}.png"), seen.inside * 255)
    return root


@pytest.fixture(scope="module")
def done(poses: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("done") / "out"
    return out, run(poses, out)


def test_larger_photos_are_matched_at_a_share_of_their_size(poses: Path, done: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """Working photos of half the size: with the originals depths are as they are without any reduction, else coarser."""
    small, ingest = tmp_path / "poses", tmp_path / "ingest"
    for folder in (small / "photos", small / "masks", ingest / "photos", ingest / "originals"):
        folder.mkdir(parents=True)
    halves = [camera.scaled(camera.width // 2, camera.height // 2) for camera in CAMERAS]
    entries, digests = [], {}
    for camera in halves:
        file, size = f"photos/{camera.name}.png", (camera.width, camera.height)
        for sub in ("photos", "masks"):
            whole = cv2.imread(str(poses / sub / f"{camera.name}.png"), cv2.IMREAD_GRAYSCALE)
            assert whole is not None
            cv2.imwrite(str(small / sub / f"{camera.name}.png"), cv2.resize(whole, size, interpolation=cv2.INTER_AREA))
        shutil.copy(small / file, ingest / file)
        shutil.copy(poses / file, ingest / "originals" / f"{camera.name}.png")
        digests[camera.name] = file_digest(ingest / file)
        original = {"original": f"originals/{camera.name}.png", "source_width": 2 * camera.width, "source_height": 2 * camera.height}
        entries.append({"name": camera.name, "file": file, "digest": digests[camera.name], "full_mask": None, "source": "a"} | original)
    (ingest / "photos.json").write_text(json.dumps({"photos": entries}))
    (small / "photo_digests.json").write_text(json.dumps(digests))
    for name in ("cameras.json", "photo_cameras.json"):
        CameraSet(tuple(halves)).save(small / name)
    errors = []
    for scale in (0.0, 0.75):
        out = tmp_path / str(scale)
        out.mkdir()
        run_stereo(small, out, Stereo(enabled="always", min_scale=scale, max_size=halves[0].width), ingest=ingest)
        depths = [read_depth(out / "depth" / f"{camera.name}.npz")[0] for camera in CAMERAS[:5]]
        assert {depth.shape[1] for depth in depths} == {round(max(0.5, scale) * CAMERAS[0].width)}
        truths = [sphere_depth(camera.downscaled_to(max(depth.shape))) for camera, depth in zip(CAMERAS, depths, strict=False)]
        errors.append(np.median(np.concatenate([np.abs(d - t)[(d > 0) & (t > 0)] for d, t in zip(depths, truths, strict=True)])))
    assert errors[1] < 0.8 * errors[0]


def test_nothing_is_matched_outside_the_region(poses: Path, done: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """The upper half of the ball: all points and depths lie there, and fewer pixels are matched."""
    shutil.copytree(poses, tmp_path / "poses")
    region = Region(np.array([0.0, 0, 1]), np.array([4.0, 4, 2]), np.eye(3))
    (tmp_path / "poses/region.json").write_text(json.dumps(region.document))
    out = tmp_path / "out"
    results = run(tmp_path / "poses", out)
    cloud = StereoCloud.load(out / "points.ply")
    whole = StereoCloud.load(done[0] / "points.ply")
    assert 200 < len(cloud) < len(whole) and cloud.points[:, 2].min() >= 0 > whole.points[:, 2].min()
    assert results["pixels"] < 0.97 * done[1]["pixels"]
    camera = next(c for c in CAMERAS if (out / "depth" / f"{c.name}.npz").exists())
    camera = camera.downscaled_to(max(read_depth(out / "depth" / f"{camera.name}.npz")[0].shape))
    depth, _ = read_depth(out / "depth" / f"{camera.name}.npz")
    points = camera.centre + (depth[..., None] * camera.rays())[depth > 0]
    assert len(points) and points[:, 2].min() > -1e-6


def test_files_and_figures(done: tuple[Path, dict[str, Any]]) -> None:
    out, results = done
    cloud = StereoCloud.load(out / "points.ply")
    assert results["points"] == len(cloud) > 1000 and 0.1 < results["confirmed_share"] < 1
    assert np.median(np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS)) < 0.004
    assert sorted(p.stem for p in (out / "depth").iterdir()) == sorted(c.name for c in CAMERAS)
    for camera in CAMERAS[:5]:
        depth, confidence = read_depth(out / "depth" / f"{camera.name}.npz")
        truth = sphere_depth(camera)
        known = depth > 0
        assert depth.shape == truth.shape and not known[cv2.erode((truth == 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0].any()
        assert np.median(np.abs(depth - truth)[known & (truth > 0)]) < 0.006
        assert ((confidence > 0) == known).all() and confidence.max() <= 1


def test_carved_hull(poses: Path, done: tuple[Path, dict[str, Any]]) -> None:
    kept, whole = Hull.load(done[0] / "hull.npz"), visual_hull(PosedPhotos.open(poses))
    # A ball has no concavity: only cells outside it are carved, where few photos bound the hull.
    assert not (kept.occupancy & ~whole.occupancy).any()
    points = kept.lower + (np.argwhere(whole.occupancy & ~kept.occupancy) + 0.5) * kept.cell
    assert (np.linalg.norm(points, axis=1) > RADIUS - kept.cell).all()


@pytest.mark.slow
def test_resume_after_interruption(poses: Path, done: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    with pytest.raises(InterruptedRun):
        run(poses, tmp_path / "cut", Recorder(("matching", 3)), tmp_path / "scratch")
    kept = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "scratch" / "planes").glob("*.npy") if ".tmp" not in p.name}
    assert 3 <= len(kept) < len(CAMERAS) + 1
    run(poses, tmp_path / "again", scratch=tmp_path / "scratch", threads=1)
    assert all((tmp_path / "scratch" / "planes" / n).stat().st_mtime_ns == t for n, t in kept.items())
    assert (tmp_path / "again" / "points.ply").read_bytes() == (done[0] / "points.ply").read_bytes()
    assert (tmp_path / "again" / "hull.npz").read_bytes() == (done[0] / "hull.npz").read_bytes()


def test_silhouettes_of_an_object_that_is_not_rigid_are_a_warning(poses: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage asks about the hull of all masks; `tests/capture/hull/test_rigidity.py` has what is found."""
    asked, monitor = [], Recorder()

    def moved_part(hull: Hull, cameras: list[Any], masks: list[Any]) -> str:
        asked.append((hull, len(cameras), len(masks)))
        return "moved"

    monkeypatch.setattr("gsbake.mvs.stereo.moved_part", moved_part)
    run(poses, tmp_path / "out", monitor, max_size=64)
    assert monitor.warnings[:1] == ["moved"] and asked[0][1:] == (len(CAMERAS), len(CAMERAS)) and not asked[0][0].empty


def test_skipping(poses: Path, tmp_path: Path) -> None:
    assert run(poses, tmp_path / "never", enabled="never") == {"points": 0} and not list((tmp_path / "never").iterdir())
    few, monitor = tmp_path / "few", Recorder()
    few.mkdir()
    CameraSet(tuple(CAMERAS[:3])).save(few / "cameras.json")
    assert run(few, tmp_path / "auto", monitor) == {"points": 0} and "3 photos" in monitor.decisions["stereo"][1]


def test_initial_points_are_stereo_and_hull_in_its_holes(poses: Path, done: tuple[Path, dict[str, Any]]) -> None:
    posed = PosedPhotos.open(poses)
    initial = initial_points(posed, done[0], 1500, 0)
    assert initial is not None
    assert 500 < initial.stereo <= 1500 and len(initial.points) > initial.stereo
    off = np.linalg.norm(initial.points, axis=1) - RADIUS
    assert np.median(np.abs(off[: initial.stereo])) < 0.003
    from_stereo, from_hull = initial.points[: initial.stereo], initial.points[initial.stereo :]
    # The matched side faces +x; the hull fills the other one.
    assert from_stereo[:, 0].mean() > 0.3 > from_hull[:, 0].mean()
    assert ((initial.normals * initial.points).sum(1) > 0).mean() > 0.95
    assert initial_points(posed, poses, 100, 0) is None  # no stereo there


def test_surfels_are_initialised_from_stereo(poses: Path, done: tuple[Path, dict[str, Any]]) -> None:
    from gsbake.surfels.initialisation import initialise_surfels

    profile = Profile()
    train = profile.train.model_copy(update={"init_surfels": 800})
    surfels, kind, why = initialise_surfels(PosedPhotos.open(poses), train, profile.surfels, 0, done[0])
    assert kind == "stereo" and "stereo points" in why and len(surfels) > 400
    _, kind, _ = initialise_surfels(PosedPhotos.open(poses), train, profile.surfels, 0, poses)
    assert kind == "hull"


def test_points_before_a_measured_depth_are_in_free_space(poses: Path) -> None:
    maps = [(c, sphere_depth(c).astype(np.float32)) for c in CAMERAS[:5]]
    points = np.array([[0.9, 0, 0], [0.69, 0, 0], [0.5, 0, 0], [-0.7, 0, 0]])
    assert in_free_space(points, iter(maps), 0.05).tolist() == [True, False, False, False]
    assert not in_free_space(points, iter(maps[:1]), 0.05).any()


def test_downsampling_is_even_and_keeps_both_sides_of_a_sheet() -> None:
    rng = np.random.default_rng(0)
    crowd = np.concatenate([rng.uniform(0, 1, (3000, 2)), rng.uniform(0, 0.2, (9000, 2))])
    points = np.concatenate([np.c_[crowd, np.zeros(12000)], np.c_[crowd, np.full(12000, 1e-3)]])
    normals = np.zeros((24000, 3))
    normals[:12000, 2], normals[12000:, 2] = -1, 1
    kept, turned, _ = voxel_downsample(points, normals, np.full((24000, 3), 0.5), np.ones(24000), 800)
    assert 500 < len(kept) <= 800 and (turned[:, 2] > 0.99).sum() == pytest.approx(len(kept) / 2, rel=0.05)
    assert (kept[:, :2].max(1) < 0.2).mean() < 0.12  # the dense corner is 4 % of the area


def test_source_views_are_five_to_thirty_degrees_away() -> None:
    ring = [camera_at(3 * np.array([np.cos(a), np.sin(a), 0.1]), str(i)) for i, a in enumerate(np.radians(np.arange(0, 360, 10)))]
    matched, asked = select_views(ring, np.zeros((1, 3)), None, 4, 8)
    for i in range(36):
        apart = [min((i - j) % 36, (j - i) % 36) * 10 for j in matched[i]]
        assert max(apart) <= 30 and len(matched[i]) == 4
        assert any((j - i) % 36 < 18 for j in matched[i]) and any((i - j) % 36 < 18 for j in matched[i])  # both sides
        assert asked[i][:4] == matched[i] and len(asked[i]) == 8
    assert select_views([ring[0], ring[18]], np.zeros((1, 3)), None, 4, 8)[0] == [[], []]
