"""Evidence for skipping work: oversampled photos, redundant photos, diffuse surfaces; and what ingest and poses skip."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from gsbake.capture.photos.redundancy import (
    MIN_COVERING_VIEWS,
    MIN_SET_SIZE,
    Coverage,
    find_covered_photos,
    find_duplicate_poses,
    find_redundant_photos,
)
from gsbake.capture.photos.sharpness import LOSSLESS_RMS, detect_oversampling, halving_loss
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.view_dependence import BrightnessStatistics, SurfaceBrightness, exposure_offsets, is_diffuse
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from tests.capture.conftest import Runner
from tests.capture.test_poses import board_capture, transforms
from tests.support.cameras import look_at
from tests.support.slow import slow


def noise(seed: int, size: int, sigma: float, spread: float = 30.0) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Band-limited noise (size, size) around 128 with the standard deviation `spread`."""
    field = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((size, size)).astype(np.float32), (0, 0), sigma)
    return np.rint(np.clip(128 + spread * field / field.std(), 0, 255)).astype(np.float32)


def test_halving_loss_separates_sharp_from_blurred() -> None:
    assert halving_loss(noise(0, 400, 0.7)) > 10
    assert halving_loss(noise(0, 400, 4.0)) < LOSSLESS_RMS
    small = noise(1, 200, 0.7)
    enlarged = np.rint(np.clip(cv2.resize(small, (400, 400), interpolation=cv2.INTER_CUBIC), 0, 255)).astype(np.float32)
    assert halving_loss(enlarged) < 0.4 * halving_loss(small)


def test_one_sharp_label_is_detail_but_not_outside_the_mask() -> None:
    photo = noise(2, 640, 6.0)
    photo[300:364, 300:364] = noise(3, 64, 0.7)
    assert halving_loss(photo) > 5
    mask = np.zeros((640, 640), np.uint8)
    mask[450:600, 50:600] = 255
    assert halving_loss(photo, mask) < LOSSLESS_RMS
    # The silhouette of a smooth object is detail: the band around the mask counts.
    disc = np.full((640, 640), 40, np.float32)
    cv2.circle(disc, (320, 320), 200, 200.0, -1)
    assert halving_loss(disc, (disc > 100).astype(np.uint8) * 255) > 5


def test_one_sharp_photo_keeps_the_resolution() -> None:
    assert detect_oversampling([0.4] * 20, 1200)[0]
    holds, evidence = detect_oversampling([0.4] * 19 + [3.25], 1200)
    assert not holds and "19 of 20" in evidence and "3.2" in evidence
    assert not detect_oversampling([0.4] * 20, 900)[0]


def ring(count: int, radius: float = 3.0) -> list[Camera]:
    """Cameras on a circle around the z axis that look at the origin."""
    cameras = []
    for i in range(count):
        a = 2 * np.pi * i / count
        centre = radius * np.array([np.cos(a), np.sin(a), 0.3])
        cameras.append(look_at(centre, size=200, focal=300.0, name=f"c{i:03d}"))
    return cameras


def ball(count: int = 400) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    normal = np.random.default_rng(0).standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return 0.6 * normal, normal


def test_video_frames_are_thinned_and_the_remaining_ones_cover_the_removed() -> None:
    points, normals = ball()
    cameras = ring(240)  # 1.5 degrees apart
    coverage = Coverage.from_cameras(cameras, points, normals)
    removed = find_covered_photos(coverage, range(240))
    assert 60 < len(removed) < 200
    kept = [i for i in range(240) if i not in removed]
    # Independently of the incremental counts: each removed photo is covered by remaining ones.
    for i in removed[::9]:
        to_camera = [(c.centre - points) / np.linalg.norm(c.centre - points, axis=1, keepdims=True) for c in cameras]
        covering = np.zeros(len(points), int)
        for j in kept:
            angle = np.degrees(np.arccos(np.clip((to_camera[i] * to_camera[j]).sum(1), -1, 1)))
            covering += (angle < 10) & coverage.visible[j]
        assert (covering[coverage.visible[i]] >= MIN_COVERING_VIEWS).mean() > 0.9


def test_small_and_sparse_sets_are_kept() -> None:
    points, normals = ball()
    assert find_covered_photos(Coverage.from_cameras(ring(48), points, normals), range(48)) == []
    few = MIN_SET_SIZE - 1
    redundant, evidence = find_redundant_photos(ring(few), {}, lambda: pytest.fail("the surface was asked for"), False)
    assert redundant == [] and f"0 of {few}" in evidence
    crowded = [c for c in ring(720)[:60]]  # half a degree apart
    assert find_redundant_photos(crowded, {}, lambda: (points, normals), True)[0]


def test_coarser_photos_do_not_cover_finer_ones() -> None:
    points, normals = ball()
    fine = ring(8)
    far = [c.scaled(100, 100) for c in ring(160)]
    removed = find_covered_photos(Coverage.from_cameras([*fine, *far], points, normals), range(168))
    assert removed and min(removed) >= 8


def test_duplicates_have_the_same_pose() -> None:
    cameras = ring(12)
    same = Camera("again", *(getattr(cameras[3], k) for k in ("width", "height", "fx", "fy", "cx", "cy", "R", "t")))
    similar = {"again": "c003", "c007": "c001"}  # c007 shows the other side of a symmetric object
    assert find_duplicate_poses([*cameras, same], similar) == [12]
    assert find_redundant_photos([*cameras, same], similar, ball, False)[0] == [12]
    assert find_redundant_photos([cameras[3], cameras[4], same], {"again": "c003"}, ball, False)[0] == []


def ball_statistics(gloss: float, exposure: bool = False) -> BrightnessStatistics:
    """Statistics of photos of a ball lit from the side, with a highlight of strength `gloss` from a light that moves with the camera."""
    points, normals = ball(900)
    brightness = SurfaceBrightness(points)
    for i, camera in enumerate(ring(16)):
        ray = camera.rays() / np.linalg.norm(camera.rays(), axis=2, keepdims=True)
        along = -(ray @ camera.centre)
        root = along**2 - camera.centre @ camera.centre + 0.6**2
        hit = camera.centre + ray * (along - np.sqrt(np.maximum(root, 0)))[..., None]
        albedo = 0.25 + 0.1 * np.sin(9 * hit[..., 2])
        light = albedo * (1 + hit[..., 0]) + gloss * np.maximum(-(ray * hit).sum(2) / 0.6, 0) ** 20
        light *= (root > 0) * (1.6 ** (i % 3 - 1) if exposure else 1.0)
        coded = np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
        photo = np.repeat(np.rint(255 * np.clip(coded, 0, 1)).astype(np.uint8)[..., None], 3, 2)
        towards = camera.centre - points
        brightness.add(camera, photo, (towards * normals).sum(1) > 0.4 * np.linalg.norm(towards, axis=1))
    return brightness.statistics()


def test_a_rough_ball_is_diffuse_and_a_glossy_one_is_not() -> None:
    diffuse = ball_statistics(0.0)
    assert diffuse.points > 200 and diffuse.median_increase < 0.03 and is_diffuse(diffuse, 0.8)[0]
    glossy = ball_statistics(0.3)
    assert glossy.view_dependent_share > 0.3 and not is_diffuse(glossy, 0.8)[0]


def test_exposure_is_not_view_dependence() -> None:
    assert is_diffuse(ball_statistics(0.0, exposure=True), 0.8)[0]
    table = np.random.default_rng(0).normal(0, 1, 300)[None] + np.array([0.4, -0.3, 0.0, 0.2, -0.1])[:, None]
    table[np.random.default_rng(1).random(table.shape) < 0.3] = np.nan
    assert np.allclose(exposure_offsets(table), [0.4, -0.3, 0.0, 0.2, -0.1], atol=1e-3)


def test_insufficient_evidence_is_not_diffuse() -> None:
    assert not is_diffuse(BrightnessStatistics(5000, 9.0, 0.01, 0.01), 0.2)[0]
    assert not is_diffuse(BrightnessStatistics(30, 9.0, 0.01, 0.01), 0.9)[0]
    empty = SurfaceBrightness(np.zeros((4, 3)))
    assert empty.statistics().points == 0 and not is_diffuse(empty.statistics(), 1.0)[0]


def blurred_photos(folder: Path, sharp: int = 0, size: int = 1000) -> Path:
    folder.mkdir(parents=True)
    for i in range(3):
        grey = noise(i, size, 0.7 if i < sharp else 5.0).astype(np.uint8)
        Image.fromarray(np.dstack([grey] * 3)).save(folder / f"p{i}.png")
    return folder


def test_ingest_halves_blurred_photos(tmp_path: Path, runner: Runner) -> None:
    photos = blurred_photos(tmp_path / "images")
    (tmp_path / "masks").mkdir()
    mask = np.zeros((1000, 1000), np.uint8)
    mask[:, 200:900] = 255
    for i in range(3):
        Image.fromarray(mask).save(tmp_path / "masks" / f"p{i}.png")
    results, done = runner.ingest(tmp_path)
    listed = json.loads((done.out / "photos.json").read_text())["photos"]
    assert {(e["width"], e["height"], e["source_width"]) for e in listed} == {(500, 500, 1000)} and results["masks"] == 3
    written = cv2.imread(str(done.out / "photos" / "p2.png"), cv2.IMREAD_COLOR)
    source = cv2.resize(cv2.imread(str(photos / "p2.png"), cv2.IMREAD_COLOR), (500, 500), interpolation=cv2.INTER_AREA)
    assert written.shape == source.shape and np.abs(written.astype(int) - source).mean() < 1.0
    halved = cv2.imread(str(done.out / "masks" / "p2.png"), cv2.IMREAD_GRAYSCALE)
    assert halved.shape == (500, 500) and halved[5, 105] == 255 and halved[5, 95] == 0
    assert "500 pixels" in done.line("skip.resolution") and "3 of 3" in done.line("skip.resolution")
    assert "3 mask files" in done.line("masks")


@pytest.mark.parametrize(("sharp", "mode", "width"), [(1, "auto", 1000), slow(0, "keep", 1000), slow(3, "skip", 500)])
def test_ingest_keeps_the_size_of_sharp_photos(tmp_path: Path, runner: Runner, sharp: int, mode: str, width: int) -> None:
    blurred_photos(tmp_path / "images", sharp)
    _, done = runner.ingest(tmp_path, resolution=mode)
    assert json.loads((done.out / "photos.json").read_text())["photos"][0]["width"] == width


def test_masks_can_be_ignored_or_required(tmp_path: Path, runner: Runner) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        rgba = np.dstack([noise(i, 64, 2.0).astype(np.uint8)] * 3 + [np.full((64, 64), 255, np.uint8)])
        rgba[:20, :, 3] = 0 if i else 255
        Image.fromarray(rgba).save(folder / f"p{i}.png")
    results, done = runner.ingest(folder, settings={"masks": "ignore"})
    assert results["masks"] == 0 and not (done.out / "masks").exists() and "set by the profile" in done.line("masks")
    with pytest.raises(BadInputError, match=r"1 of 3 photos have no mask \(p0\), but ingest\.masks is require"):
        Runner(tmp_path / "again").ingest(folder, settings={"masks": "require"})


def test_given_poses_can_be_ignored_or_required(tmp_path: Path, runner: Runner) -> None:
    true = board_capture(tmp_path / "cap")
    runner.ingest(tmp_path / "cap")
    with pytest.raises(BadInputError, match=r"No poses were given, but poses\.source is given"):
        runner.poses(source="given")
    transforms(tmp_path / "cap", true)
    again = Runner(tmp_path / "again")
    again.ingest(tmp_path / "cap")
    results, done = again.poses(source="solve", max_features=2000)
    assert results["poses"] == "solved" and "given for 8 of 8" in done.line("pose source")


@pytest.mark.slow
def test_poses_drops_a_duplicate_photo(tmp_path: Path, runner: Runner) -> None:
    true = board_capture(tmp_path / "cap")
    with Image.open(tmp_path / "cap" / "images" / "b2.png") as photo:
        photo.save(tmp_path / "cap" / "images" / "again.png", compress_level=1)
    twin = Camera("again", *(getattr(true[2], k) for k in ("width", "height", "fx", "fy", "cx", "cy", "R", "t")))
    transforms(tmp_path / "cap", [*true, twin])
    runner.ingest(tmp_path / "cap")
    results, done = runner.poses(max_features=1000)
    names = [c.name for c in CameraSet.load(done.out / "cameras.json").cameras]
    assert len(results["dropped_photos"]) == 1 and len(names) == 8 and {"again", "b2"} - set(names)
    assert sorted(p.stem for p in (done.out / "photos").iterdir()) == sorted(names) and len(PosedPhotos.open(done.out)) == 8
