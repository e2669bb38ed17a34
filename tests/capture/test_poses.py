from __future__ import annotations

import json
import os
import time
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.sfm.process import JobCallbacks, run_job
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.ply import write_cloud
from gsbake.imaging.png import read_grey, write_png
from tests.capture.conftest import Done, Runner
from tests.support.cameras import look_at
from tests.support.slow import slow


def textured_board(size: int = 600) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """An image with corners at several scales."""
    rng = np.random.default_rng(5)
    board = np.zeros((size, size, 3), np.float32)
    for cells in (8, 25, 75, 200):
        board += cv2.resize(rng.random((cells, cells, 3)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(board * 64, 0, 255), np.uint8)


def photograph(camera: Camera, board: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Photo of a board that spans [-1, 1]² with a step in depth: the left half at z = 0, the right half at z = 0.4."""
    rays, eye = camera.rays(), camera.centre
    photo = np.full((camera.height, camera.width, 3), 90, np.uint8)
    depth = np.full((camera.height, camera.width), np.inf)
    for z, sides in ((0.0, (-1.0, 0.0)), (0.4, (0.0, 1.0))):
        s = (z - eye[2]) / rays[..., 2]
        hit = eye + s[..., None] * rays
        inside = (s > 0) & (hit[..., 0] > sides[0]) & (hit[..., 0] < sides[1]) & (np.abs(hit[..., 1]) < 1) & (s < depth)
        at = ((hit[..., :2] + 1) * 0.5 * (board.shape[0] - 1)).astype(np.float32)
        seen = cv2.remap(board, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        photo[inside], depth[inside] = seen[inside], s[inside]
    return photo


def board_capture(folder: Path, count: int = 8) -> list[Camera]:
    """Photos of the board from an arc, and their true cameras."""
    (folder / "images").mkdir(parents=True)
    board = textured_board()
    cameras = []
    for i in range(count):
        a = np.radians(-40 + 80 * i / (count - 1))
        eye = np.array([3 * np.sin(a), -1.5 + 0.1 * i, 3 * np.cos(a)])
        camera = look_at(eye, size=(320, 240), focal=380.0, name=f"b{i}", up=(0.0, 1.0, 0.0))
        Image.fromarray(photograph(camera, board)).save(folder / "images" / f"b{i}.png")
        cameras.append(camera)
    return cameras


def transforms(folder: Path, cameras: list[Camera]) -> None:
    frames = [{"file_path": f"images/{c.name}.png", "transform_matrix": c.camera_to_world_opengl().tolist()} for c in cameras]
    c = cameras[0]
    body = {"fl_x": c.fx, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(body))


def aligned_error(found: np.ndarray[Any, Any], true: np.ndarray[Any, Any]) -> float:
    """Largest distance between point sets (n, 3) after the best similarity (Umeyama 1991), over the spread of the true ones."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s @ np.diag(sign)) / (a**2).sum()
    return float(np.linalg.norm(scale * a @ (u @ sign @ vt).T - b, axis=1).max() / np.linalg.norm(b, axis=1).max())


def test_solved_poses_are_the_true_ones(tmp_path: Path, runner: Runner) -> None:
    true = board_capture(tmp_path / "cap")
    runner.ingest(tmp_path / "cap")
    results, done = runner.poses(max_features=2000)
    assert results["registered"] == 8 and results["reprojection_px"] < 0.8 and results["poses"] == "solved"
    posed = PosedPhotos.open(done.out)
    cameras = posed.cameras.cameras
    assert aligned_error(np.stack([c.centre for c in cameras]), np.stack([c.centre for c in true])) < 0.005
    assert [c.distortion for c in cameras] == [()] * 8
    view = posed.view(3)
    assert view.rgb.shape == (cameras[3].height, cameras[3].width, 3)
    cloud = posed.points()
    assert cloud is not None and len(cloud[0]) > 200
    assert np.median(np.linalg.norm(cloud[0], axis=1)) < 1
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {p.name for p in (done.out / "sparse").iterdir()}
    assert {"features", "matching", "mapping", "refinement", "undistortion", "normalisation"} <= set(done.parts)
    assert results["refinement"]["used"] and results["refinement"]["refined_px"][1] < 0.2
    assert any(text == "features" and count for count, _, text in done.progressed)
    ups = np.stack([-c.R[1] for c in cameras]) @ posed.cameras.to_world.rotation.T
    assert ups[:, 2].mean() > 0.5


@pytest.mark.parametrize("given", [slow(False, id="solved"), pytest.param(True, id="given")])
def test_the_same_bytes_with_any_number_of_threads(tmp_path: Path, runner: Runner, given: bool) -> None:
    true = board_capture(tmp_path / "cap")
    if given:
        transforms(tmp_path / "cap", true)
    runner.ingest(tmp_path / "cap")
    digests = []
    for k, threads in enumerate((2, 3, 1)):
        _, done = runner.poses(out=f"poses {k}", threads=threads, max_features=1000)
        files = [path for path in done.out.rglob("*") if path.is_file()]
        digests.append({path.relative_to(done.out).as_posix(): sha256(path.read_bytes()).hexdigest() for path in files})
    assert {"points.ply", "cameras.json", "sparse/images.bin", "sparse/points3D.bin"} <= set(digests[0])
    assert digests[0] == digests[1] and digests[0] == digests[2]


def metashape(folder: Path, cameras: list[Camera], region: str) -> None:
    """The file that Metashape writes of these cameras."""
    c = cameras[0]
    inner = f'<resolution width="{c.width}" height="{c.height}"/><f>{c.fx}</f><cx>{c.cx - c.width / 2}</cx><cy>{c.cy - c.height / 2}</cy>'
    entries = []
    for camera in cameras:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.R.T, camera.centre
        text = " ".join(map(repr, pose.ravel().tolist()))
        entries.append(f'<camera label="{camera.name}" sensor_id="0"><transform>{text}</transform></camera>')
    (folder / "cameras.xml").write_text(
        f'<document version="1.5.0"><chunk><sensors><sensor id="0" type="frame"><calibration type="frame" class="adjusted">{inner}'
        f"</calibration></sensor></sensors><cameras>{''.join(entries)}</cameras>{region}</chunk></document>"
    )


@pytest.mark.parametrize("masked", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_only_the_region_is_kept(tmp_path: Path, runner: Runner, masked: bool) -> None:
    """Metashape's region around the board's right half: masks show no more of it, tie points lie in it, and it gives the frame."""
    true = board_capture(tmp_path / "cap")
    metashape(tmp_path / "cap", true, "<region><center>.5 0 .4</center><size>1 2 .3</size><R>1 0 0 0 1 0 0 0 1</R></region>")
    if masked:
        (tmp_path / "cap/masks").mkdir()
        for camera in true:
            Image.fromarray(np.full((camera.height, camera.width), 255, np.uint8)).save(tmp_path / "cap/masks" / f"{camera.name}.png")
    runner.ingest(tmp_path / "cap", poses=tmp_path / "cap/cameras.xml")
    settings: dict[str, Any] = {"max_features": 1000, "cache": tmp_path / "features"}
    results, done = runner.poses(**settings)
    posed = PosedPhotos.open(done.out)
    region, to_world = posed.region, posed.cameras.to_world
    assert region is not None and done.decisions["region"][0] == "from the file of the cameras"
    assert json.loads((done.out / "region.json").read_text())["size"] == [1, 2, 0.3]
    cloud = posed.points()
    assert cloud is not None and region.contains(cloud[0]).all() and 0 <= to_world.apply(cloud[0])[:, 0].min() < 0.2
    _, mask = posed.mask(3)
    if masked:
        assert mask is not None and np.array_equal(mask, region.silhouette(posed.cameras.cameras[3])) and 0 < (mask > 0).mean() < 0.6
    else:
        assert mask is None and np.allclose(results["centre"], [0.5, 0, 0.4]) and results["radius"] == pytest.approx(np.sqrt(5.09) / 2)
    box = (0.5, 0.0, 0.4, 0.5, 0.5, 0.5, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    _, other = runner.poses(out="by hand", **settings, region_box=box)
    assert other.decisions["region"][0] == "set by --region" and '"size": [0.5, 0.5, 0.5]' in other.decisions["region"][1]
    _, whole = runner.poses(out="whole", **settings, region="none")
    assert not (whole.out / "region.json").exists() and whole.decisions["region"][0] == "none"
    with pytest.raises(BadInputError, match="the region lies in no photo"):
        runner.poses(out="beside", **settings, region_box=(50.0, *box[1:]))
    if masked:
        for path in (runner.root / "ingest" / "masks").iterdir():  # the object is at the left edge of all photos
            write_png(path, np.where(np.arange(320) < 4, read_grey(path), 0).astype(np.uint8))
        with pytest.raises(BadInputError, match="beside the object in the masks"):
            runner.poses(out="off", **settings, region_box=(0.6, 0.0, 0.4, 0.1, 0.1, 0.1, *box[6:]))


def test_given_poses_keep_their_frame_and_points_are_triangulated(tmp_path: Path, runner: Runner) -> None:
    true = board_capture(tmp_path / "cap")
    transforms(tmp_path / "cap", true)
    _, ingested = runner.ingest(tmp_path / "cap", max_size=160)
    listing = json.loads((ingested.out / "photos.json").read_text(encoding="utf-8"))
    listing["photos"][0]["flash"], listing["photos"][2]["flash"] = True, False
    (ingested.out / "photos.json").write_text(json.dumps(listing), encoding="utf-8")
    results, done = runner.poses(max_features=2000)
    assert done.line("pose source") == "given (given for 8 of 8 photos)"
    posed = PosedPhotos.open(done.out)
    assert [camera.flash for camera in posed.cameras.cameras] == [True, None, False] + [None] * 5
    world = posed.cameras.to_world
    for camera, wanted in zip(posed.cameras.cameras, true, strict=True):
        back = camera.moved(world)
        assert np.allclose(back.R, wanted.R, atol=1e-9) and np.allclose(back.t, wanted.t, atol=1e-9)
        assert (back.fx, back.cx, back.width) == (190, 80, 160)
    assert results["points"] > 50 and posed.cameras.epipolar_px == results["epipolar_px"] < 0.4
    cloud = posed.points()
    assert cloud is not None
    height = world.apply(cloud[0])[:, 2]
    assert np.median(np.minimum(np.abs(height), np.abs(height - 0.4))) < 0.02  # on one of the board's two planes


@pytest.mark.slow
def test_points_are_triangulated_with_the_lens_of_a_telephoto(tmp_path: Path, runner: Runner) -> None:
    """Calibrations of long lenses have coefficients above 1, which COLMAP takes for a failure where it solves for them itself."""
    transforms(tmp_path / "cap", board_capture(tmp_path / "cap"))
    file = tmp_path / "cap" / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"k3": 1.5}))
    runner.ingest(tmp_path / "cap")
    results, _ = runner.poses(max_features=2000)
    assert results["poses"] == "given" and results["points"] > 100


def test_photos_of_unrelated_places(tmp_path: Path, runner: Runner) -> None:
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    for i in range(4):
        photo = cv2.resize(rng.integers(0, 255, (30, 40, 3), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
        Image.fromarray(np.asarray(photo, np.uint8)).save(tmp_path / "images" / f"p{i}.png")
    runner.ingest(tmp_path)
    with pytest.raises(BadInputError, match=r"registered only \d of 4 photos \(not p.*overlap"):
        runner.poses(max_features=500)


@pytest.mark.slow
def test_steps_of_registration_are_reported(tmp_path: Path, runner: Runner) -> None:
    """A photo of another place: weaker thresholds are tried, and the report says what they gained."""
    board_capture(tmp_path / "cap")
    noise = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    photo = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    Image.fromarray(np.asarray(photo, np.uint8)).save(tmp_path / "cap" / "images" / "other.png")
    runner.ingest(tmp_path / "cap")
    results, done = runner.poses(max_features=2000, fine_features=True)
    assert results["not_registered"] == ["other"]
    line = done.line("registration")
    assert "8 of 9 photos after 2 steps" in line and "strict thresholds, finest octave of features: 8, weaker thresholds" in line


def test_too_few_given_poses(tmp_path: Path, runner: Runner) -> None:
    true = board_capture(tmp_path / "cap", 4)
    transforms(tmp_path / "cap", true[:2])
    _, done = runner.ingest(tmp_path / "cap")
    assert any("2 photos have no pose" in w for w in done.warnings)
    with pytest.raises(BadInputError, match="Only 2 photos have a pose"):
        runner.poses()


@pytest.mark.slow
def test_more_photos_cost_their_own_features_and_matches(tmp_path: Path) -> None:
    """With kept features and matches the result has the same bytes; damaged files are computed again."""
    board_capture(tmp_path / "cap", 7)
    last, aside, cache = tmp_path / "cap" / "images" / "b6.png", tmp_path / "b6.png", tmp_path / "cache"

    def solve(run: str, kept: Path | None) -> tuple[tuple[int, ...], bytes]:
        runner = Runner(tmp_path / run)
        runner.ingest(tmp_path / "cap")
        figures, done = runner.poses(max_features=2000, cache=kept)
        counts = tuple(figures[name] for name in ("photos_detected", "pairs_matched", "pairs_verified"))
        return counts, (done.out / "photo_cameras.json").read_bytes()

    last.rename(aside)
    assert solve("six", cache)[0] == (6, 15, 15)
    aside.rename(last)
    alone, expected = solve("alone", None)
    assert alone[1:] == (21, 21)
    counts, found = solve("seven", cache)
    assert counts == (1, 6, 6) and found == expected
    for kind in ("features", "matches", "geometry"):
        damaged = sorted((cache / kind).iterdir())
        damaged[0].write_bytes(damaged[0].read_bytes()[:-40])
        damaged[1].write_bytes(b"")
    counts, found = solve("damaged", cache)
    assert counts == (2, 2, 2) and found == expected


def test_a_stop_kills_the_process(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    for i in range(6):
        Image.fromarray(rng.integers(0, 255, (900, 1200, 3), np.uint8)).save(tmp_path / "images" / f"p{i}.png", compress_level=0)
    lens = {"names": [f"p{i}" for i in range(6)], "width": 1200, "height": 900, "focal": None}
    (tmp_path / "work").mkdir()
    job = {
        "task": "solve", "photos": str(tmp_path / "images"), "masks": None, "work": str(tmp_path / "work"), "lenses": [lens], "cache": None,
        "max_features": 8192, "peak_threshold": 0.001, "max_size": 1600, "fine": True, "threads": 1, "seed": 0, "matching": "exhaustive",
        "mapper": "incremental", "one_camera": [],
    }  # fmt: skip
    parts: list[str] = []
    asked: list[float] = []

    def stop() -> bool:
        if parts and not asked:
            asked.append(time.monotonic())
        return bool(asked)

    assert run_job(job, tmp_path / "out", JobCallbacks(lambda part, done, total: parts.append(part), stop)) is None
    assert time.monotonic() - asked[0] < 3
    assert parts[0] == "features"
    tails = [Path(f"/proc/{p}/cmdline") for p in os.listdir("/proc") if p.isdigit()] if Path("/proc").is_dir() else []
    for tail in tails:
        try:
            assert str(tmp_path).encode() not in tail.read_bytes()
        except OSError:
            continue  # ended meanwhile


def test_a_stop_request_interrupts_the_stage(tmp_path: Path, runner: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    board_capture(tmp_path / "cap", 4)
    runner.ingest(tmp_path / "cap")

    def raised(self: Done) -> None:
        raise InterruptedRun("Stopped on request.")

    monkeypatch.setattr(Done, "stop_requested", lambda self: True)
    monkeypatch.setattr(Done, "check_stop", raised)
    with pytest.raises(InterruptedRun):
        runner.poses()


def test_masks_centre_the_object(tmp_path: Path, runner: Runner) -> None:
    """RGBA photos of a ball: its radius in the unit frame is 0.9."""
    from tests.capture.hull.test_visual_hull import CENTRE, RADIUS, ball_mask, ring

    (tmp_path / "images").mkdir()
    cameras = ring(16)
    for camera in cameras:
        noise = np.random.default_rng(int(camera.name[1:])).integers(0, 255, (160, 160, 3), np.uint8)
        Image.fromarray(np.dstack([noise, ball_mask(camera)])).save(tmp_path / "images" / f"{camera.name}.png")
    transforms(tmp_path, cameras)
    runner.ingest(tmp_path)
    results, done = runner.poses(max_features=256)
    assert results["centre"] == pytest.approx(CENTRE, abs=0.04) and results["radius"] == pytest.approx(RADIUS, rel=0.08)
    assert "visual hull of 16 masks" in done.line("unit frame")
    assert CameraSet.load(done.out / "cameras.json").to_world.scale == pytest.approx(results["radius"] / 0.9)


def test_an_incomplete_mask_is_completed(tmp_path: Path, runner: Runner) -> None:
    """A ball with given poses and points; in one photo the mask misses a disc in its middle."""
    from tests.capture.hull.test_visual_hull import CENTRE, RADIUS, ball_mask, ring

    (tmp_path / "images").mkdir()
    cameras = ring(16)
    for camera in cameras:
        mask = ball_mask(camera)
        if camera.name == "c05":
            rows, columns = np.nonzero(mask)
            cv2.circle(mask, (int(columns.mean()), int(rows.mean())), 14, 0, -1)
        noise = np.random.default_rng(int(camera.name[1:])).integers(0, 255, (160, 160, 3), np.uint8)
        Image.fromarray(np.dstack([noise, mask])).save(tmp_path / "images" / f"{camera.name}.png")
    transforms(tmp_path, cameras)
    runner.ingest(tmp_path)
    points = np.random.default_rng(0).normal(size=(800, 3))
    points = CENTRE + RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)
    write_cloud(runner.root / "ingest" / "poses" / "points.ply", points, np.full((800, 3), 90, np.uint8))
    _, done = runner.poses()
    assert done.line("mask completion").startswith("1 of 16") and "c05" in done.line("mask completion")
    for camera in cameras:
        completed = cv2.imread(str(done.out / "masks" / f"{camera.name}.png"), cv2.IMREAD_GRAYSCALE)
        assert completed is not None and ((completed > 127) != (ball_mask(camera) > 127)).mean() < 0.002


@pytest.mark.slow
def test_kermit(captures: Path, runner: Runner) -> None:
    runner.ingest(captures / "kermit")
    results, _ = runner.poses()
    assert results["registered"] == 11 and results["reprojection_px"] < 0.6
