"""Masks by themselves: guesses in the ingest stage, corrected masks in the poses stage, files to edit."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from gsbake.capture import ingest as ingestion
from gsbake.capture.masks import weights
from gsbake.capture.masks.consensus import MIN_CERTAIN_OVERLAP, intersection_over_union
from gsbake.capture.masks.editing import export_masks
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.sfm.solve import PoseSolver
from gsbake.errors import BadInputError, UsageError
from gsbake.geometry.cameras import Camera
from gsbake.geometry.ply import write_cloud
from tests.capture.conftest import Runner
from tests.support.cameras import look_at
from tests.support.shapes import bar_masks

COUNT, SIZE = 16, 160


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Photos of a bright bar with given poses; the network of `guesses` finds it by its brightness."""
    folder = tmp_path / "cap"
    (folder / "images").mkdir(parents=True)
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    eyes = [4 * np.array([np.cos(a), np.sin(a), 0.5]) for a in angles]
    cameras = [look_at(eye, size=SIZE, focal=200, name=f"p{i:02}") for i, eye in enumerate(eyes)]
    rng = np.random.default_rng(0)
    for name, path in bar_masks(tmp_path / "truth", cameras).items():
        inside = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127
        photo = np.where(inside[..., None], 220, rng.integers(20, 90, (SIZE, SIZE, 3)))
        Image.fromarray(photo.astype(np.uint8)).save(folder / "images" / f"{name}.png")
    write_poses(folder / "transforms.json", cameras)
    return folder


def write_poses(path: Path, cameras: list[Camera]) -> None:
    first = cameras[0]
    frames = [{"file_path": f"images/{c.name}.png", "transform_matrix": c.camera_to_world_opengl().tolist()} for c in cameras]
    size = {"fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": SIZE, "h": SIZE}
    path.write_text(json.dumps({**size, "frames": frames}))


@pytest.fixture
def network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Puts a threshold in the network's place; it misses half of every `wrong`-th photo."""

    def install(wrong: int) -> None:
        count = 0

        class Threshold:
            def __init__(self, threads: int) -> None:
                pass

            def probability(self, rgb: Any) -> Any:
                nonlocal count
                found = np.where(rgb.min(2) > 150, 255, 0).astype(np.uint8)
                if wrong and count % wrong == 0:
                    found[: SIZE // 2] = 0
                count += 1
                return found

        weight = tmp_path / "u2netp.onnx"
        weight.touch()
        monkeypatch.setattr(weights, "WEIGHTS", weight)
        monkeypatch.setattr(ingestion, "SaliencyNetwork", Threshold)

    return install


def test_masks_are_made_corrected_and_written_for_editing(
    capture: Path, network: Callable[[int], None], runner: Runner, tmp_path: Path
) -> None:
    network(8)
    figures, done = runner.ingest(capture, mask_network="auto")
    assert figures["masks"] == 0 and figures["guessed_masks"] == COUNT
    assert done.line("automatic masks").startswith("guessed by u2netp (16 of 16 photos have no mask")
    write_cloud(runner.root / "ingest" / "poses" / "points.ply", np.zeros((1, 3)), np.zeros((1, 3), np.uint8))  # no structure from motion
    figures, done = runner.poses()
    assert figures["automatic_masks"] == COUNT and figures["corrected_masks"] >= 2 and set(figures["doubtful_masks"]) <= {"p00", "p08"}
    assert MIN_CERTAIN_OVERLAP < figures["mask_agreement"] <= 1
    posed = PosedPhotos.open(runner.root / "poses")
    assert posed.has_masks
    for i, camera in enumerate(posed.cameras.cameras):
        truth = cv2.imread(str(tmp_path / "truth" / f"{camera.name}.png"), cv2.IMREAD_GRAYSCALE) > 127
        assert intersection_over_union(posed.view(i).mask > 127, truth) > 0.85, camera.name  # type: ignore[operator]

    files = export_masks(runner.root / "ingest", runner.root / "poses", tmp_path / "edit")
    assert [path.name for path in files] == [f"p{i:02}.png" for i in range(COUNT)]
    with pytest.raises(UsageError, match="holds other files"):
        export_masks(runner.root / "ingest", runner.root / "poses", tmp_path / "edit")
    (only,) = export_masks(runner.root / "ingest", runner.root / "poses", tmp_path / "one", frozenset({"p08"}))
    with pytest.raises(BadInputError, match="is doubtful"):
        export_masks(runner.root / "ingest", runner.root / "poses", tmp_path / "none", frozenset())
    edited = np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(edited, (80, 80), 30, 255, -1)
    cv2.imwrite(str(only), edited)

    again = Runner(tmp_path / "again")
    figures, _ = again.ingest(capture, masks=tmp_path / "one", mask_network="auto")
    assert figures["masks"] == 1 and figures["guessed_masks"] == COUNT - 1
    write_cloud(again.root / "ingest" / "poses" / "points.ply", np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    figures, _ = again.poses()
    assert figures["automatic_masks"] == COUNT - 1
    kept = cv2.imread(str(again.root / "poses" / "masks" / "p08.png"), cv2.IMREAD_GRAYSCALE)
    assert intersection_over_union(kept > 127, edited > 127) == 1, "what the user edited is not corrected"


@pytest.mark.slow
def test_guesses_that_no_camera_agrees_with_are_not_used(capture: Path, network: Callable[[int], None], runner: Runner) -> None:
    network(0)
    poses = json.loads((capture / "transforms.json").read_text())
    matrices = [frame["transform_matrix"] for frame in poses["frames"]]
    for frame, i in zip(poses["frames"], np.random.default_rng(0).permutation(COUNT), strict=True):
        frame["transform_matrix"] = matrices[i]
    (capture / "transforms.json").write_text(json.dumps(poses))
    runner.ingest(capture, mask_network="auto")
    write_cloud(runner.root / "ingest" / "poses" / "points.ply", np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    figures, done = runner.poses()
    assert figures["automatic_masks"] == 0 and figures["mask_agreement"] < 0.8
    assert done.line("automatic masks").startswith("not used (the guesses of the network agree with the cameras to 0.")
    assert not (runner.root / "poses" / "masks").exists()


@pytest.mark.parametrize("on_table", [False, True])
def test_before_a_turntable_guesses_may_agree_less(
    capture: Path, network: Callable[[int], None], runner: Runner, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, on_table: bool
) -> None:
    """Every second photo shows a part of the room above the object that looks like one of it."""
    network(0)
    for path in sorted((capture / "images").iterdir())[::2]:
        photo = np.array(Image.open(path))
        photo[20:75, 60:110] = 220
        Image.fromarray(photo).save(path)
    runner.ingest(capture, mask_network="auto")
    write_cloud(runner.root / "ingest" / "poses" / "points.ply", np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    given = PoseSolver.triangulate
    monkeypatch.setattr(PoseSolver, "triangulate", lambda solver: replace(given(solver), on_table=on_table))
    figures, done = runner.poses()
    assert 0.7 < figures["mask_agreement"] < 0.88
    assert (figures["automatic_masks"] == COUNT) == on_table == done.line("automatic masks").startswith("used")


def test_without_weights_the_run_says_how_to_get_them(
    capture: Path, runner: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (weights, ingestion):
        monkeypatch.setattr(module, "WEIGHTS", tmp_path / "absent.onnx")
    figures, done = runner.ingest(capture, mask_network="auto")
    assert figures["guessed_masks"] == 0 and not (runner.root / "ingest" / "guesses").exists()
    assert "weights are not installed" in done.line("automatic masks")
    assert any("run `gsbake doctor --fetch-weights`" in text for text in done.warnings)
    with pytest.raises(BadInputError, match="has no masks"):
        export_masks(runner.root / "ingest", None, tmp_path / "edit")


def test_masks_that_are_ignored_are_not_made(capture: Path, network: Callable[[int], None], runner: Runner) -> None:
    network(0)
    figures, done = runner.ingest(capture, mask_network="auto", settings={"masks": "ignore"})
    assert figures["guessed_masks"] == 0 and "automatic masks" not in done.decisions
