"""`gsbake batch` on Snakemake's local executor, with toy stages."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import psutil
import pytest

import gsbake.api
from gsbake.batch import coordinator, workflow
from gsbake.batch.captures import BatchOptions
from gsbake.batch.coordinator import run_batch
from gsbake.batch.records import all_records
from gsbake.python_process import python_command, python_environment
from tests.batch import flaky
from tests.cli.conftest import Run

pytest.importorskip("snakemake")
Make = Callable[..., Path]


def stages_run(out: Path) -> list[str]:
    """Stages that were started in an output folder, in order."""
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    return [event["stage"] for event in events if event["event"] == "stage started"]


def test_a_batch_with_a_bad_capture(run: Run, make_capture: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    captures = [make_capture("first"), make_capture("poor", photos=2), make_capture("third")]
    end = run("batch", *captures, "--profile", "smoke", "--json", "--threads", "2")
    document = json.loads(end.out[: end.out.rindex("}\n{") + 1])
    assert end.code == 42 and "1 of 3 captures failed; poor: There are 2 photos; give more." in end.err
    assert [c["state"] for c in document["captures"]] == ["done", "failed", "done"]
    out = tmp_path / "out"
    assert (out / "first" / "asset.glb").is_file() and stages_run(out / "poor") == ["ingest"]  # bad input is not tried again
    jobs = json.loads((out / ".batch" / "snakemake" / "jobs.json").read_text())["jobs"]
    assert [job["threads"] for job in jobs] == [1, 1, 1]  # side by side on two cores
    page = (out / "index.html").read_text()
    assert "There are 2 photos; give more." in page and 'href="third/report.html"' in page and "http" not in page.replace("http-equiv", "")

    def refuse(*_: object) -> None:
        raise AssertionError("nothing is left to run")

    with monkeypatch.context() as patch:
        patch.setattr(coordinator, "run_workflow", refuse)
        again = run("batch", *captures, "--profile", "smoke", "--threads", "2", "--quiet")
        assert again.code == 42 and stages_run(out / "poor") == ["ingest"]  # nor in the next batch
        status = run("batch", "status", "--json").json
        assert [c["state"] for c in status["captures"]] == ["cached", "failed", "cached"]
    (captures[1] / "images" / "new.jpg").write_text("one more")
    assert run("batch", *captures, "--profile", "smoke", "--threads", "2", "--quiet").code == 0
    assert stages_run(out / "poor") == ["ingest", "ingest", "mesh", "export", "report"]
    assert stages_run(out / "first") == ["ingest", "mesh", "export", "report"]  # untouched


@pytest.mark.slow
def test_interrupted_jobs_are_tried_again(make_capture: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(gsbake.api, "REGISTRY", flaky.REGISTRY)
    outcomes = run_batch([make_capture("one", seed="flaky")], BatchOptions(tmp_path / "out", "smoke", threads=1))
    assert [o.state for o in outcomes] == ["done"]
    assert stages_run(tmp_path / "out" / "one") == ["ingest", "mesh", "mesh", "export", "report"]  # ingest is not computed again


_COORDINATOR = """
import sys
from pathlib import Path
import gsbake.api
from tests.batch import flaky
gsbake.api.REGISTRY = flaky.REGISTRY
from gsbake.batch.captures import BatchOptions
from gsbake.batch.coordinator import run_batch
run_batch([Path(sys.argv[1])], BatchOptions(Path(sys.argv[2]), "smoke", threads=1))
"""


@pytest.mark.slow
def test_a_batch_goes_on_after_its_coordinator_was_killed(make_capture: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    capture, root = make_capture("one", seed="slow"), tmp_path / "out"
    command = python_command("-c", _COORDINATOR, str(capture), str(root))
    with subprocess.Popen(command, env=python_environment()) as process:
        events = root / "one" / "events.jsonl"
        deadline = time.monotonic() + 120
        while not (events.exists() and stages_run(root / "one") == ["ingest", "mesh"]) and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(1.0)  # the stage has noted its first attempt
        os.kill(process.pid, signal.SIGKILL)
    monkeypatch.setattr(gsbake.api, "REGISTRY", flaky.REGISTRY)
    outcomes = run_batch([capture], BatchOptions(root, "smoke", threads=1))
    assert [o.state for o in outcomes] == ["done"], all_records(root)
    assert stages_run(root / "one").count("ingest") == 1


def test_a_relative_store_is_that_of_the_caller(run: Run, make_capture: Make, tmp_path: Path) -> None:
    end = run("plan", make_capture("one"), "--store", "shared", "--emit", "json")
    assert end.json["jobs"][0]["command"][-2:] == ["--store", str(tmp_path / "shared")]


@pytest.mark.slow
def test_memory_of_jobs_is_limited(make_capture: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Jobs that expect more memory than is free run one at a time instead of not at all."""
    monkeypatch.setattr(gsbake.api, "REGISTRY", flaky.REGISTRY)
    free = psutil.virtual_memory()._replace(available=10**9)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    outcomes = run_batch([make_capture("one"), make_capture("two")], BatchOptions(tmp_path / "out", "smoke", threads=2))
    assert [o.state for o in outcomes] == ["done", "done"]
    document = json.loads((tmp_path / "out" / ".batch" / "snakemake" / "jobs.json").read_text())
    assert [job["memory_mb"] for job in document["jobs"]] == [900, 900]
    first, second = sorted((r.finished, r.seconds) for r in all_records(tmp_path / "out"))
    gap = datetime.fromisoformat(second[0]) - datetime.fromisoformat(first[0])
    assert gap.total_seconds() >= second[1]  # the second began after the first had ended


def test_missing_packages_are_named(run: Run, make_capture: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = make_capture("one")
    with monkeypatch.context() as patch:
        patch.setenv("PATH", "")
        assert "needs Slurm's command sbatch" in run("batch", capture, "--executor", "slurm").err
    monkeypatch.setattr(workflow.importlib.util, "find_spec", lambda name: None)
    end = run("batch", capture)
    assert end.code == 2 and "needs snakemake: pip install 'gsbake[batch]'" in end.err
    assert run("batch", capture, "--executor", "grid").code == 2
    assert run("batch", "status", "--out", "nowhere").code == 2
