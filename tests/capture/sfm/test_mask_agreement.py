"""Cameras that contradict the masks are recognised, and structure from motion is tried again inside the masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.sfm import solve
from gsbake.capture.sfm.mask_agreement import mask_agreement
from gsbake.capture.sfm.solve import MIN_AGREEMENT, PoseSolver
from gsbake.config.schema import Poses
from gsbake.geometry.cameras import Camera, CameraSet
from tests.support.cameras import look_at
from tests.support.recorder import Recorder

COUNT = 16


def ring(turn: float = 1.0) -> list[Camera]:
    """Cameras on a ring around the origin, `turn` full turns in all."""
    angles = 2 * np.pi * turn * np.arange(COUNT) / COUNT
    centres = [4 * np.array([np.cos(a), np.sin(a), 0.5]) for a in angles]
    return [replace(look_at(c, size=160, focal=200), name=f"p{i:02}") for i, c in enumerate(centres)]


def write_masks(folder: Path, cameras: list[Camera]) -> dict[str, Path]:
    """Silhouettes of a curved bar: it looks different from every side."""
    folder.mkdir(parents=True)
    t = np.linspace(-1, 1, 60)
    line = np.stack([0.8 * t, 0.5 * t**2, 0.4 * t], 1)
    rng = np.random.default_rng(0)
    points = (line[:, None] + 0.15 * rng.normal(size=(60, 200, 3)) / 2).reshape(-1, 3)
    files = {}
    for camera in cameras:
        mask = np.zeros((camera.height, camera.width), np.uint8)
        at = np.round(camera.project(points)[0]).astype(int)
        mask[at[:, 1], at[:, 0]] = 255
        files[camera.name] = folder / f"{camera.name}.png"
        cv2.imwrite(str(files[camera.name]), cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    return files


def test_true_cameras_agree_and_wrong_ones_do_not(tmp_path: Path) -> None:
    cameras = ring()
    masks = write_masks(tmp_path / "masks", cameras)
    assert mask_agreement(cameras, masks) > MIN_AGREEMENT
    assert mask_agreement(ring(0.3), masks) < 0.7  # a background that hardly turned
    broken = [replace(c, distortion=(-9.0, 0.0, 0.0, 0.0)) for c in cameras]
    assert mask_agreement(broken, masks) == 0


@pytest.mark.parametrize(("setting", "attempts", "masked"), [("auto", 2, True), (False, 1, False)])
def test_contradicted_solution_is_tried_again(
    setting: Any, attempts: int, masked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole photos are tied together by the background, features inside the masks find the true cameras."""
    cameras, jobs = ring(), []
    write_masks(tmp_path / "ingest" / "masks", cameras)
    rng = np.random.default_rng(1)
    (tmp_path / "ingest" / "photos").mkdir()
    for camera in cameras:  # the background changes, as after the camera was moved
        cv2.imwrite(str(tmp_path / "ingest" / "photos" / f"{camera.name}.png"), rng.integers(0, 255, (160, 160, 3)).astype(np.uint8))
    entries = [
        {"name": c.name, "file": f"photos/{c.name}.png", "mask": f"masks/{c.name}.png", "width": 160, "height": 160, "camera_model": None,
         "focal_px": None}
        for c in cameras
    ]  # fmt: skip

    def run_job(job: Mapping[str, Any], out: Path, *_: object) -> dict[str, Any]:
        jobs.append(job)
        out.mkdir(parents=True)
        CameraSet(tuple(cameras if job["masks"] else ring(0.3)), poses="solved").save(out / "cameras.json")
        figures = {"reprojection_px": 0.4, "points": 100, "track_length": 4.0, "fine_features": False, "seconds": {}}
        return {"registered": COUNT, "missing": [], **figures}

    monkeypatch.setattr(solve, "run_job", run_job)
    solver = PoseSolver(tmp_path / "ingest", entries, tmp_path / "scratch", Poses(masked_features=setting), 0, 1, Recorder())
    solved = solver.solve()
    assert len(jobs) == attempts and solved.figures["masked_features"] is masked
    assert len({job["work"] for job in jobs}) == attempts
    expected = cameras if masked else ring(0.3)
    np.testing.assert_allclose(solved.cameras[5].centre, expected[5].centre, atol=1e-9)
    kept = CameraSet.load(solver.folder / "cameras.json").cameras
    assert len(kept) == COUNT and kept[5].centre == pytest.approx(expected[5].centre)
