"""The live view: what it serves, to whom, and that it is gone when the run ends."""

from __future__ import annotations

import http.client
import json
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from gsbake.live.picture import draw, newest_source
from gsbake.live.server import LiveView
from gsbake.live.state import LiveState
from gsbake.pipeline.engine import Observer
from tests.support.browser import visit


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


@pytest.fixture
def view(tmp_path: Path) -> Any:
    with LiveView(LiveState(Spy()), tmp_path, "sech2") as live:
        yield live


def get(view: LiveView, path: str, **headers: str) -> tuple[int, bytes]:
    host, port = view.hosts[0].split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_state_progress_curves_and_decisions(view: LiveView) -> None:
    a_run(view.state)
    seen = view.state.display.seen  # type: ignore[attr-defined]
    assert seen[0] == "train: training" and seen[-1] == "train 699"
    code, body = get(view, f"/{view.token}/state.json")
    found = json.loads(body)
    assert code == 200 and not found["ended"]
    assert found["stages"][0] | {"left": ""} == {
        "name": "train", "title": "Training <b>", "status": "running", "done": 699, "total": 1000, "text": "", "left": "",
    }  # fmt: skip
    curve = found["curves"]["psnr"]
    assert len(curve) <= 600 and curve[0] == [1, 20.01] and curve[-1] == pytest.approx([699, 26.99])
    assert [line["kind"] for line in found["lines"]] == ["decision", "warning"] and "\\u202e" in found["lines"][0]["text"]


def test_only_with_the_token_and_on_loopback(view: LiveView) -> None:
    assert view.address.startswith("http://127.0.0.1:") and len(view.token) >= 22
    assert get(view, f"/{view.token}/")[0] == 200
    for path in ("/", "/state.json", f"/{view.token[:-1]}x/", f"/{view.token}/../server.py", f"/{view.token}/server.py"):
        assert get(view, path) == (404, b""), path
    assert get(view, f"/{view.token}/state.json", Host="evil.example")[0] == 404
    assert get(view, f"/{view.token}/picture.jpg")[0] == 404  # none yet
    request = urllib.request.Request(view.address, data=b"x", method="POST")
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=10)
    assert refused.value.code == 501
    refused.value.close()


def test_it_is_gone_when_the_run_ends(tmp_path: Path) -> None:
    with LiveView(LiveState(Spy()), tmp_path, "sech2") as live:
        address = live.address
        assert urllib.request.urlopen(f"{address}state.json", timeout=10).status == 200
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address, timeout=10)


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


@pytest.mark.slow
def test_the_page_in_a_browser(view: LiveView, tmp_path: Path) -> None:
    a_run(view.state)
    view._picture = cv2.imencode(".jpg", np.full((40, 60, 3), 90, np.uint8))[1].tobytes()
    shown = "[...document.querySelectorAll('td')].map(cell => cell.textContent).join('|')"
    steps = [
        {"wait": "document.querySelector('polyline') && !document.getElementById('picture').hidden"}, {"evaluate": shown},
        {"evaluate": "document.getElementById('picture').naturalWidth"}, {"evaluate": "document.querySelectorAll('#lines li').length"},
    ]  # fmt: skip
    found = visit(view.address, steps, tmp_path)
    assert found["errors"] == []
    assert all(address.startswith(view.address) for address in found["requests"])
    assert "699 of 1000" in found["results"][0] and found["results"][1:] == [60, 2]
