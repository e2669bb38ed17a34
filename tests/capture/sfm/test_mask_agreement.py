"""Cameras that contradict the masks are recognised, and structure from motion is tried again inside the masks; guesses
serve as well."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.sfm import solve
from gsbake.capture.sfm.lenses import is_plausible_lens
from gsbake.capture.sfm.mask_agreement import MIN_AGREEMENT, mask_agreement
from gsbake.capture.sfm.solve import PoseSolver
from gsbake.config.schema import Poses
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.ply import write_cloud
from tests.support.cameras import look_at
from tests.support.recorder import Recorder
from tests.support.shapes import bar_masks

COUNT = 16


def ring(turn: float = 1.0) -> list[Camera]:
    """Cameras on a ring around the origin, `turn` full turns in all."""
    angles = 2 * np.pi * turn * np.arange(COUNT) / COUNT
    centres = [4 * np.array([np.cos(a), np.sin(a), 0.5]) for a in angles]
    return [replace(look_at(c, size=160, focal=200), name=f"p{i:02}") for i, c in enumerate(centres)]


def test_true_cameras_agree_and_wrong_ones_do_not(tmp_path: Path) -> None:
    cameras = ring()
    masks = bar_masks(tmp_path / "masks", cameras)
    assert mask_agreement(cameras, masks) > MIN_AGREEMENT
    assert mask_agreement(ring(0.3), masks) < 0.7  # a background that hardly turned
    broken = [replace(c, distortion=(-9.0, 0.0, 0.0, 0.0)) for c in cameras]
    assert mask_agreement(broken, masks) == 0


def write_capture(folder: Path, cameras: list[Camera], kind: str) -> list[dict[str, Any]]:
    """Photos whose background changes, as after the camera was moved, with masks under the key `kind` (mask or guess); their entries."""
    rng = np.random.default_rng(1)
    bar_masks(folder / kind, cameras)
    (folder / "photos").mkdir()
    for camera in cameras:
        cv2.imwrite(str(folder / "photos" / f"{camera.name}.png"), rng.integers(0, 255, (160, 160, 3)).astype(np.uint8))
    return [
        {"name": c.name, "file": f"photos/{c.name}.png", "mask": None, "guess": None, "width": 160, "height": 160, "camera_model": None,
         "focal_px": None, kind: f"{kind}/{c.name}.png"}
        for c in cameras
    ]  # fmt: skip


Jobs = list[Mapping[str, Any]]


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Mapping[str, Any]], list[Camera]]], Jobs]:
    """Puts cameras in the place of structure from motion; the jobs that were asked for."""

    def install(cameras_of: Callable[[Mapping[str, Any]], list[Camera]]) -> Jobs:
        jobs: Jobs = []

        def run_job(job: Mapping[str, Any], out: Path, *_: object) -> dict[str, Any]:
            jobs.append(job)
            out.mkdir(parents=True)
            cameras = cameras_of(job)
            CameraSet(tuple(cameras), poses="solved").save(out / "cameras.json")
            write_cloud(out / "points.ply", np.random.default_rng(0).normal(0, 0.3, (50, 3)), np.zeros((50, 3)))
            figures = {"reprojection_px": 0.4, "points": 100, "track_length": 4.0, "fine_features": False, "seconds": {}}
            counts = {"detected": 0, "matched": 0, "verified": 0, "steps": [["strict thresholds", len(cameras)]]}
            refinement = {"refinement": {"used": False, "decision": ["not used", "no photos"]}}
            return {"registered": len(cameras), "missing": [], **counts, **figures, **refinement}

        monkeypatch.setattr(solve, "run_job", run_job)
        return jobs

    return install


def solver(tmp_path: Path, entries: list[dict[str, Any]], setting: Any = "auto") -> PoseSolver:
    return PoseSolver(tmp_path / "ingest", entries, tmp_path / "scratch", Poses(masked_features=setting), 0, 1, Recorder())


@pytest.mark.parametrize("kind", ["mask", "guess"])
@pytest.mark.parametrize(("setting", "attempts", "masked"), [("auto", 2, True), (False, 1, False)])
def test_contradicted_solution_is_tried_again(
    setting: Any, attempts: int, masked: bool, kind: str, tmp_path: Path, answers: Callable[..., Jobs]
) -> None:
    """Whole photos are tied together by the background, features inside the masks find the true cameras."""
    cameras = ring()
    entries = write_capture(tmp_path / "ingest", cameras, kind)
    jobs = answers(lambda job: cameras if job["masks"] else ring(0.3))
    run = solver(tmp_path, entries, setting)
    solved = run.solve()
    assert len(jobs) == attempts and solved.figures["masked_features"] is masked
    assert len({job["work"] for job in jobs}) == attempts
    expected = cameras if masked else ring(0.3)
    np.testing.assert_allclose(solved.cameras[5].centre, expected[5].centre, atol=1e-9)
    kept = CameraSet.load(run.folder / "cameras.json").cameras
    assert len(kept) == COUNT and kept[5].centre == pytest.approx(expected[5].centre)


@pytest.mark.parametrize(("kind", "advice"), [("mask", "correct masks of the object"), (None, "give masks of the object")])
def test_an_impossible_lens_is_explained_by_movement(kind: str | None, advice: str, tmp_path: Path, answers: Callable[..., Jobs]) -> None:
    """Cameras that tie a moving object to its surroundings end in a distortion that no lens has; the message is about the photos."""
    warped = [replace(c, distortion=(1.9, 0.0, 0.0, 0.0)) for c in ring()]
    entries = write_capture(tmp_path / "ingest", ring(), kind or "mask")
    if kind is None:
        entries = [{**e, "mask": None} for e in entries]
    answers(lambda job: warped)
    with pytest.raises(BadInputError, match="moved against its surroundings") as caught:
        solver(tmp_path, entries).solve()
    assert advice in str(caught.value) and "lens" not in str(caught.value) and "calibration" not in str(caught.value)


def test_lenses() -> None:
    """Wide-angle lenses distort by a quarter at most; what cannot be inverted is no lens."""
    camera = replace(ring()[0], fx=100.0, fy=100.0)
    assert is_plausible_lens(camera)
    assert is_plausible_lens(replace(camera, distortion=(-0.1, 0.0, 0.0, 0.0)))
    assert not is_plausible_lens(replace(camera, distortion=(0.4, 0.0, 0.0, 0.0)))
    assert not is_plausible_lens(replace(camera, distortion=(-0.9, 0.0, 0.0, 0.0)))


@pytest.mark.slow
def test_a_right_model_of_one_position_beats_a_wrong_one_of_both(tmp_path: Path, answers: Callable[..., Jobs]) -> None:
    """An object that was laid down otherwise: whole photos register all of them on the table, the masks only one position."""
    entries = write_capture(tmp_path / "ingest", ring(), "guess")
    answers(lambda job: ring()[::2] if job["masks"] else ring(0.3))
    run = solver(tmp_path, entries)
    solved = run.solve()
    assert solved.figures["masked_features"] is True and len(solved.cameras) == COUNT // 2
    assert "8 of 16 photos registered by features inside the masks" in run.monitor.line("features")  # type: ignore[attr-defined]


@pytest.mark.parametrize("right", ["whole photos", "masks"])
def test_a_trial_on_small_photos_decides_what_is_mapped_at_full_size(
    right: str, tmp_path: Path, answers: Callable[..., Jobs], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One job at full size, of the features that the trial found right; no trial after a right one."""
    monkeypatch.setattr(solve, "MIN_CAPTURE", COUNT)
    monkeypatch.setattr("gsbake.capture.sfm.standing_background.MIN_SUSPECTED_PHOTOS", 0.0)
    entries = write_capture(tmp_path / "ingest", ring(), "guess")
    jobs = answers(lambda job: ring() if (job["masks"] is not None) == (right == "masks") else ring(0.3))
    run = solver(tmp_path, entries)
    solved = run.solve()
    trials, full = [job for job in jobs if job["mapper"] == "trial"], [job for job in jobs if job["mapper"] != "trial"]
    assert len(full) == 1 and solved.figures["masked_features"] is (right == "masks")
    assert [job["masks"] is not None for job in trials] == ([False, True] if right == "masks" else [False])
    assert all(Path(job["photos"]).parent.name == "trial" for job in trials) and not (tmp_path / "scratch" / "trial").exists()
    assert "16 small photos: whole photos: 16 registered" in run.monitor.line("features")  # type: ignore[attr-defined]


def test_photos_that_share_no_background_need_no_trial(
    tmp_path: Path, answers: Callable[..., Jobs], monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr(solve, "MIN_CAPTURE", COUNT)
    entries = write_capture(tmp_path / "ingest", ring(), "guess")
    jobs = answers(lambda job: ring())
    solver(tmp_path, entries).solve()
    assert [job["mapper"] for job in jobs] == ["incremental"]


@pytest.mark.parametrize("setting", ["auto", False])
def test_cameras_that_coincide_are_no_solution(setting: Any, tmp_path: Path, answers: Callable[..., Jobs]) -> None:
    """A standing camera, whatever the silhouettes say; where nothing else is tried, a warning."""
    standing = [replace(ring()[0], name=camera.name) for camera in ring()]
    entries = write_capture(tmp_path / "ingest", standing, "mask")  # equal silhouettes: their hull agrees with all
    jobs = answers(lambda job: ring() if job["masks"] else standing)
    run = solver(tmp_path, entries, setting)
    run.solve()
    warned = [text for text in run.monitor.warnings if "16 cameras coincide with others" in text]  # type: ignore[attr-defined]
    assert (len(jobs), len(warned)) == ((2, 0) if setting == "auto" else (1, 1))
