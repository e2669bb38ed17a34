"""An object on a turntable in a cluttered room, from two heights: features of the room are left out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.sfm.solve import PoseSolver
from gsbake.config.schema import Poses
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import encode_bytes
from gsbake.synth import scene
from gsbake.synth.capture import look_at
from gsbake.synth.shade import render, studio_rig
from tests.support.recorder import Recorder

SIZE, VIEWS, HEIGHTS = 288, 12, (20.0, 48.0)


def clutter(shift: tuple[int, int]) -> NDArray[np.uint8]:
    """A wall of coloured boxes, seen from elsewhere with `shift`."""
    rng = np.random.default_rng(5)
    wall = np.full((SIZE, SIZE, 3), (90, 110, 100), np.uint8)
    for _ in range(260):
        colour, low = rng.integers(0, 255, 3).tolist(), rng.integers(-30, SIZE + 30, 2) + shift
        high = low + rng.integers(8, 50, 2)
        cv2.rectangle(wall, low.tolist(), high.tolist(), colour, -1)
    return wall


def turntable(folder: Path) -> tuple[list[dict[str, Any]], list[Camera]]:
    """Photos and slightly too large guesses of their masks; the entries of photos.json and the cameras as the object sees them."""
    for sub in ("photos", "guesses"):
        (folder / sub).mkdir(parents=True)
    rng, rig = np.random.default_rng(3), studio_rig()
    entries, cameras = [], []
    for row, height in enumerate(HEIGHTS):
        wall = clutter((37 * row, -22 * row))
        for i in range(VIEWS):
            turn, up = 2 * math.pi * (i + 0.5 * row) / VIEWS, math.radians(height)
            target = np.array(scene.CENTRE)
            eye = target + 2.5 * np.array([math.cos(up) * math.cos(turn), math.cos(up) * math.sin(turn), math.sin(up)])
            camera = look_at(f"{row}{i:02}", eye, target, 0.0, 1.5 * SIZE, (SIZE / 2, SIZE / 2), SIZE)
            image, _ = render(
                camera.R, camera.centre, camera.fx, camera.fy, camera.cx, camera.cy, SIZE, SIZE, rig, False, scene.NO_MARKER
            )  # fmt: skip
            alpha = image[..., 3:]
            photo = encode_bytes(image[..., :3] / np.maximum(alpha, 1e-9)) * alpha + wall * (1 - alpha) + rng.normal(0, 1.5, wall.shape)
            cv2.imwrite(str(folder / "photos" / f"{camera.name}.png"), np.clip(photo[..., ::-1], 0, 255).astype(np.uint8))
            guess = cv2.dilate(255 * (alpha[..., 0] > 0.5).astype(np.uint8), np.ones((3, 3), np.uint8))
            cv2.imwrite(str(folder / "guesses" / f"{camera.name}.png"), guess)
            names = {"file": f"photos/{camera.name}.png", "mask": None, "guess": f"guesses/{camera.name}.png"}
            entries.append({"name": camera.name, **names, "width": SIZE, "height": SIZE, "camera_model": None, "focal_px": None})
            cameras.append(camera)
    return entries, cameras


@pytest.mark.slow
def test_a_turntable_in_a_room_is_solved_from_the_object(tmp_path: Path) -> None:
    entries, true = turntable(tmp_path / "ingest")
    (tmp_path / "scratch").mkdir()
    monitor = Recorder()
    solved = PoseSolver(tmp_path / "ingest", entries, tmp_path / "scratch", Poses(), 0, 2, monitor).solve()
    assert solved.figures["moving_features"] is True and solved.figures["registered"] == len(true)
    assert monitor.decisions["features"][0] == "on what moves"
    assert solved.on_table and monitor.decisions["turntable"] == ("found", "24 of 24 photos on exact circles")
    angles = turn_errors(true, solved.cameras)
    assert np.median(angles) < 0.3 and max(angles) < 1  # of turns by 30°, from some 50 matches a photo


def turn_errors(true: list[Camera], solved: list[Camera]) -> list[float]:
    """Degrees between the turns from photo to photo and the true ones."""
    found = {camera.name: camera for camera in solved}
    angles = []
    for first, second in zip(true, true[1:], strict=False):
        expected, got = first.R @ second.R.T, found[first.name].R @ found[second.name].R.T
        angles.append(float(np.degrees(np.arccos(np.clip((np.trace(expected.T @ got) - 1) / 2, -1, 1)))))
    return angles


@pytest.mark.slow
def test_a_trial_decides_where_the_background_is_not_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two dozen small photos say that whole photos contradict the masks: at full size only these are mapped."""
    monkeypatch.setattr("gsbake.capture.sfm.standing_background.MIN_STANDING_PHOTOS", 1.1)
    monkeypatch.setattr("gsbake.capture.sfm.solve.MIN_CAPTURE", 20)
    entries, true = turntable(tmp_path / "ingest")
    (tmp_path / "scratch").mkdir()
    monitor = Recorder()
    solved = PoseSolver(tmp_path / "ingest", entries, tmp_path / "scratch", Poses(), 0, 2, monitor).solve()
    assert monitor.decisions["features"][0] == "inside the masks"
    assert "24 small photos: whole photos: " in monitor.decisions["features"][1]
    assert not (tmp_path / "scratch" / "colmap").exists() and (tmp_path / "scratch" / "colmap_masked").exists()
    names = {camera.name for camera in solved.cameras}
    assert solved.figures["masked_features"] is True and len(names) >= len(true) - 2
    assert np.median(turn_errors([camera for camera in true if camera.name in names], solved.cameras)) < 0.8
