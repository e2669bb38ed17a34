"""Evidence from a capture: sharpness, redundant photos, steady colours; and what ingest and poses leave out because of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from gsbake.capture.photos.redundancy import ENOUGH, LEAST_PHOTOS, Coverage, covered_by_others, saved_twice, spare_photos
from gsbake.capture.photos.sharpness import LOSSLESS, finer_than_sharp, loss_at_half
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.view_dependence import Changes, Sightings, exposures, looks_diffuse
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from tests.capture.conftest import Runner
from tests.capture.test_poses import board_capture, transforms


def noise(seed: int, size: int, sigma: float, spread: float = 30.0) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Band-limited noise (size, size) around 128 with the standard deviation `spread`."""
    field = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((size, size)).astype(np.float32), (0, 0), sigma)
    return np.rint(np.clip(128 + spread * field / field.std(), 0, 255)).astype(np.float32)


def test_loss_at_half_tells_sharp_from_blurred() -> None:
    assert loss_at_half(noise(0, 400, 0.7)) > 10
    assert loss_at_half(noise(0, 400, 4.0)) < LOSSLESS
    small = noise(1, 200, 0.7)
    enlarged = np.rint(np.clip(cv2.resize(small, (400, 400), interpolation=cv2.INTER_CUBIC), 0, 255)).astype(np.float32)
    assert loss_at_half(enlarged) < 0.4 * loss_at_half(small)


def test_one_sharp_label_is_detail_but_not_outside_the_mask() -> None:
    photo = noise(2, 640, 6.0)
    photo[300:364, 300:364] = noise(3, 64, 0.7)
    assert loss_at_half(photo) > 5
    mask = np.zeros((640, 640), np.uint8)
    mask[450:600, 50:600] = 255
    assert loss_at_half(photo, mask) < LOSSLESS
    # The silhouette of something smooth is detail: the rim of the mask counts.
    disc = np.full((640, 640), 40, np.float32)
    cv2.circle(disc, (320, 320), 200, 200.0, -1)
    assert loss_at_half(disc, (disc > 100).astype(np.uint8) * 255) > 5


def test_a_sharp_photo_keeps_them_all() -> None:
    assert finer_than_sharp([0.4] * 20, 1200)[0]
    holds, evidence = finer_than_sharp([0.4] * 19 + [3.25], 1200)
    assert not holds and "19 of 20" in evidence and "3.2" in evidence
    assert not finer_than_sharp([0.4] * 20, 900)[0]


def ring(count: int, radius: float = 3.0) -> list[Camera]:
    """Cameras on a circle around the z axis that look at the origin."""
    cameras = []
    for i in range(count):
        a = 2 * np.pi * i / count
        centre = radius * np.array([np.cos(a), np.sin(a), 0.3])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, (0, 0, 1.0))
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(f"c{i:03d}", 200, 200, 300.0, 300.0, 100.0, 100.0, turn, -turn @ centre))
    return cameras


def ball(count: int = 400) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    normal = np.random.default_rng(0).standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return 0.6 * normal, normal


def test_frames_of_a_video_are_thinned_and_what_stays_covers_the_rest() -> None:
    points, normals = ball()
    cameras = ring(240)  # 1.5 degrees apart
    seen = Coverage.of(cameras, points, normals)
    gone = covered_by_others(seen, range(240))
    assert 60 < len(gone) < 200
    kept = [i for i in range(240) if i not in gone]
    # Independently of the counts kept along the way: each photo that went has its others among those that stay.
    for i in gone[::9]:
        to_camera = [(c.centre - points) / np.linalg.norm(c.centre - points, axis=1, keepdims=True) for c in cameras]
        beside = np.zeros(len(points), int)
        for j in kept:
            angle = np.degrees(np.arccos(np.clip((to_camera[i] * to_camera[j]).sum(1), -1, 1)))
            beside += (angle < 10) & seen.sees[j]
        assert (beside[seen.sees[i]] >= ENOUGH).mean() > 0.9


def test_small_and_wide_sets_are_kept() -> None:
    points, normals = ball()
    assert covered_by_others(Coverage.of(ring(48), points, normals), range(48)) == []
    few = LEAST_PHOTOS - 1
    spare, evidence = spare_photos(ring(few), {}, lambda: pytest.fail("the surface was asked for"), False)
    assert spare == [] and f"0 of {few}" in evidence
    crowded = [c for c in ring(720)[:60]]  # half a degree apart
    assert spare_photos(crowded, {}, lambda: (points, normals), True)[0]


def test_a_coarser_photo_does_not_stand_in_for_a_finer_one() -> None:
    points, normals = ball()
    fine = ring(8)
    far = [c.scaled(100, 100) for c in ring(160)]
    gone = covered_by_others(Coverage.of([*fine, *far], points, normals), range(168))
    assert gone and min(gone) >= 8


def test_saved_twice_needs_the_same_pose() -> None:
    cameras = ring(12)
    same = Camera("again", *(getattr(cameras[3], k) for k in ("width", "height", "fx", "fy", "cx", "cy", "R", "t")))
    alike = {"again": "c003", "c007": "c001"}  # c007 looks like c001, from the other side of a symmetric thing
    assert saved_twice([*cameras, same], alike) == [12]
    assert spare_photos([*cameras, same], alike, ball, False)[0] == [12]
    assert spare_photos([cameras[3], cameras[4], same], {"again": "c003"}, ball, False)[0] == []


def shown(gloss: float, exposure: bool = False) -> Changes:
    """Photos of a ball lit from the side, with a highlight of the strength `gloss` of a light that is carried with the camera."""
    points, normals = ball(900)
    sightings = Sightings(points)
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
        sightings.add(camera, photo, (towards * normals).sum(1) > 0.4 * np.linalg.norm(towards, axis=1))
    return sightings.changes()


def test_a_matt_ball_is_diffuse_and_a_glossy_one_is_not() -> None:
    matt = shown(0.0)
    assert matt.places > 200 and matt.typical < 0.03 and looks_diffuse(matt, 0.8)[0]
    glossy = shown(0.3)
    assert glossy.shining > 0.3 and not looks_diffuse(glossy, 0.8)[0]


def test_exposure_is_no_view_dependence() -> None:
    assert looks_diffuse(shown(0.0, exposure=True), 0.8)[0]
    table = np.random.default_rng(0).normal(0, 1, 300)[None] + np.array([0.4, -0.3, 0.0, 0.2, -0.1])[:, None]
    table[np.random.default_rng(1).random(table.shape) < 0.3] = np.nan
    assert np.allclose(exposures(table), [0.4, -0.3, 0.0, 0.2, -0.1], atol=1e-3)


def test_little_evidence_is_no_verdict() -> None:
    assert not looks_diffuse(Changes(5000, 9.0, 0.01, 0.01), 0.2)[0]
    assert not looks_diffuse(Changes(30, 9.0, 0.01, 0.01), 0.9)[0]
    empty = Sightings(np.zeros((4, 3)))
    assert empty.changes().places == 0 and not looks_diffuse(empty.changes(), 1.0)[0]


def soft_photos(folder: Path, sharp: int = 0, size: int = 1000) -> Path:
    folder.mkdir(parents=True)
    for i in range(3):
        grey = noise(i, size, 0.7 if i < sharp else 5.0).astype(np.uint8)
        Image.fromarray(np.dstack([grey] * 3)).save(folder / f"p{i}.png")
    return folder


def test_ingest_keeps_blurred_photos_at_half_their_size(tmp_path: Path, runner: Runner) -> None:
    photos = soft_photos(tmp_path / "images")
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


@pytest.mark.parametrize(("sharp", "mode", "width"), [(1, "auto", 1000), (0, "never", 1000), (3, "always", 500)])
def test_ingest_keeps_the_size_of_sharp_photos(tmp_path: Path, runner: Runner, sharp: int, mode: str, width: int) -> None:
    soft_photos(tmp_path / "images", sharp)
    _, done = runner.ingest(tmp_path, resolution=mode)
    assert json.loads((done.out / "photos.json").read_text())["photos"][0]["width"] == width


def test_masks_can_be_passed_over_or_asked_for(tmp_path: Path, runner: Runner) -> None:
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


def test_given_poses_can_be_passed_over_or_asked_for(tmp_path: Path, runner: Runner) -> None:
    true = board_capture(tmp_path / "cap")
    runner.ingest(tmp_path / "cap")
    with pytest.raises(BadInputError, match=r"No poses were given, but poses\.source is given"):
        runner.poses(source="given")
    transforms(tmp_path / "cap", true)
    again = Runner(tmp_path / "again")
    again.ingest(tmp_path / "cap")
    results, done = again.poses(source="solve", max_features=2000)
    assert results["poses"] == "solved" and "given for 8 of 8" in done.line("pose source")


def test_poses_drops_a_photo_saved_twice(tmp_path: Path, runner: Runner) -> None:
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
