"""`--view` names the page of a run, on loopback, and changes nothing else."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from gsbake.studio import server
from gsbake.studio.server import MODULES
from tests.cli.conftest import Run


def test_a_run_says_where_its_page_is(run: Run, capture: Path) -> None:
    for module in MODULES:
        pytest.importorskip(module, reason="the extra `studio` is not installed")
    end = run("run", capture, "--out", "o", "--view", "--quiet")
    assert end.code == 0 and re.search(r"Live view: http://127\.0\.0\.1:\d+/\?token=[\w-]{20,}#/o/run\n", end.err)
    assert Path("o/asset.glb").exists() and "Live view" not in run("run", "--out", "o").err


def test_without_the_extra_one_sentence_names_it(run: Run, capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MODULES", ("starlette", "a_module_that_is_not_there"))
    for words in (("run", capture, "--out", "o", "--view"), ("studio", ".")):
        end = run(*words)
        assert end.code == 2 and end.err.count("\n") == 1 and "pip install 'gsbake[studio]'" in end.err


def test_status_tells_of_a_run_in_progress(run: Run, capture: Path) -> None:
    assert run("run", capture, "--out", "o").code == 0
    assert "in progress" not in run("status", "--out", "o").out
    live = Path("o/live.json")
    stages = [{"name": "mesh", "status": "running", "done": 3, "total": 9, "left": "about 2 min left"}]
    live.write_text(json.dumps({**json.loads(live.read_text()), "ended": False, "stages": stages}))  # this process, which lives
    assert re.search(r"in progress, process \d+ .*: mesh, 3 of 9, about 2 min left", run("status", "--out", "o").out)
    assert run("status", "--out", "o", "--json").json["running"]["pid"] > 0


def test_the_studio_wants_a_folder_of_captures(run: Run, capture: Path) -> None:
    for module in MODULES:
        pytest.importorskip(module, reason="the extra `studio` is not installed")
    for folder, sentence in ((capture, "is itself a capture"), (capture / "images", "is itself a capture"), ("nowhere", "is no folder")):
        end = run("studio", folder, "--no-browser")
        assert end.code == 2 and sentence in end.err
