"""live.json, by which others know of a run, and the picture of its present state."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from gsbake.pipeline.engine import Observer
from gsbake.studio.live import LiveRun, LiveState
from gsbake.studio.picture import draw, newest_source


class Spy(Observer):
    """Records that events are passed on."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def part_started(self, name: str, part: str) -> None:
        self.seen.append(f"{name}: {part}")

    def progress(self, name: str, done: int, total: int, text: str, live: Any) -> None:
        self.seen.append(f"{name} {done}")


def a_run(state: LiveState) -> None:
    stage: Any = SimpleNamespace(name="train", title="Training <b>", reasons=(), artifact=None)
    state.run_started([stage, SimpleNamespace(name="mesh", title="Mesh")])  # type: ignore[list-item]
    state.stage_started(stage)
    state.part_started("train", "training")
    for step in range(1, 700):
        state.progress("train", step, 1000, "", {"psnr": 20 + step / 100})
    state.decision("train", "poses", "kept", "no gain \u202e")
    state.warning("train", "a warning")


def test_state_progress_curves_and_decisions(tmp_path: Path) -> None:
    spy = Spy()
    state = LiveState(spy, tmp_path)
    a_run(state)
    assert spy.seen[0] == "train: training" and spy.seen[-1] == "train 699"
    found = json.loads(json.dumps(state.snapshot()))
    assert not found["ended"] and found["pid"] == os.getpid()
    assert found["stages"][0] | {"left": ""} == {
        "name": "train", "title": "Training <b>", "status": "running", "done": 699, "total": 1000, "text": "", "left": "",
    }  # fmt: skip
    curve = found["curves"]["train: psnr"]
    assert len(curve) <= 600 and curve[0] == [1, 20.01] and curve[-1] == pytest.approx([699, 26.99])
    assert [line["kind"] for line in found["lines"]] == ["decision", "warning"] and "\\u202e" in found["lines"][0]["text"]
    state.end(75, "stopped \u202e")
    live = LiveRun.read(tmp_path)
    assert live is not None and not live.runs and live.document["exit_code"] == 75 and live.document["message"] == "stopped \\u202e"


def test_the_file_follows_the_run_and_tells_of_its_process(tmp_path: Path) -> None:
    state = LiveState(Spy(), tmp_path)
    a_run(state)
    deadline = time.monotonic() + 10
    while (live := LiveRun.read(tmp_path)) is None or not live.document["lines"]:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert live.runs and live.summary.startswith("train, 699 of 1000")
    second = LiveState(Spy(), tmp_path)
    a_run(second)
    second.end(0)  # one run writes at a time
    live = LiveRun.read(tmp_path)
    assert live is not None and live.runs
    state.end(0)
    state.end(0)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"ended": false}', '{"ended": false, "pid": "x"}', '{"stages": 3}', "[" * 100_000])
def test_a_damaged_file_is_no_run(text: str, tmp_path: Path) -> None:
    (tmp_path / "live.json").write_text(text)
    live = LiveRun.read(tmp_path)
    assert live is None or (not live.runs and live.summary)


def test_a_killed_run_does_not_run(tmp_path: Path) -> None:
    state = LiveState(Spy(), tmp_path)
    a_run(state)
    state.end(0)
    document = json.loads((tmp_path / "live.json").read_text())
    (tmp_path / "live.json").write_text(json.dumps({**document, "ended": False, "pid": 2**22 + 1}))
    live = LiveRun.read(tmp_path)
    assert live is not None and not live.runs and not live.document["ended"]


def test_the_newest_file_is_drawn(tmp_path: Path) -> None:
    from gsbake.geometry.cameras import CameraSet
    from gsbake.geometry.ply import write_mesh
    from gsbake.surfels.model import create
    from tests.support.cameras import look_at

    assert newest_source(tmp_path, 0) is None
    for name in ("poses", "train", "mesh"):
        (tmp_path / "stages" / name / "a").mkdir(parents=True)
    CameraSet((look_at(np.array([2.5, 0, 0]), size=64, focal=80.0, name="c"),)).save(tmp_path / "stages/poses/a/cameras.json")
    ball = trimesh.creation.icosphere(subdivisions=3)
    points, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    surfels = create(points, points, np.full(len(points), 0.2), np.full_like(points, 0.2), "colour", 0, 0.0, 20.0)
    surfels.save(tmp_path / "stages/train/a/surfels.safetensors")
    first = newest_source(tmp_path, 0)
    assert first is not None and first.path.name == "surfels.safetensors"
    image = draw(tmp_path, first.path, "sech2")
    assert image.shape == (64, 64, 3) and abs(image[32, 32].mean() - 0.2) < 0.1 and abs(image[0, 0].mean() - 0.86) < 0.01
    write_mesh(tmp_path / "stages/mesh/a/dense.ply", points, faces)
    second = newest_source(tmp_path, 0)
    assert second is not None and second.path.name == "dense.ply" and newest_source(tmp_path, second.time + 10) is None
    shape = draw(tmp_path, second.path, "sech2")
    assert shape[32, 32].mean() > 0.8 and shape[32, 32].mean() > shape[32, 44].mean()
