"""`gsbake plan`: jobs, their estimates, and the formats of schedulers."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from gsbake.batch.captures import BatchOptions, plan_captures
from gsbake.batch.emit import FORMATS, as_openjd, emit
from gsbake.batch.jobs import Job, make_jobs
from gsbake.errors import UsageError
from gsbake.stages import ORDER
from gsbake.timing.estimate import History, at_threads, formula
from gsbake.timing.photos import PhotoSet
from tests.cli.conftest import Run

Make = Callable[..., Path]


def job(number: int, stage: str = "mesh", needs: tuple[str, ...] = (), name: str = "") -> Job:
    capture = name or f"it's {number}"
    command = ("gsbake", stage, f"/photos/{capture}", "--out", f"/out/{capture}", "--quiet")
    identifier = f"c{number:04d}_{stage}"
    return Job(identifier, capture, f"/photos/{capture}", f"/out/{capture}", (stage,), command, needs, 2, 900, 60.0, 10)


def test_jobs_of_two_captures_with_the_bad_one_named(run: Run, make_capture: Make, tmp_path: Path) -> None:
    good, other = make_capture("good"), make_capture("other")
    empty = tmp_path / "empty"
    empty.mkdir()
    end = run("plan", good, empty, other, "--emit", "json", "--profile", "smoke")
    jobs = end.json["jobs"]
    assert [job["capture"] for job in jobs] == ["good", "other"]  # small stages share a job
    assert jobs[0]["stages"] == ["ingest", "mesh", "export", "report"] and jobs[0]["needs"] == []
    assert end.code == 42 and "1 of 3 captures cannot be baked; empty: " in end.err
    command = jobs[0]["command"]
    assert command[:3] == ["gsbake", "report", str(good)]
    assert run(*command[1:]).code == 0  # the command is one that gsbake takes
    again = run("plan", good, "--profile", "smoke")
    assert again.code == 0 and "0 jobs" in again.out and "1 captures are done" in again.out


def test_long_stages_are_jobs_of_their_own(run: Run, make_capture: Make, tmp_path: Path) -> None:
    options = BatchOptions(tmp_path / "out", "smoke")
    jobs = make_jobs(plan_captures([make_capture("one")], options), options, History(), threads=1, pack_seconds=12.0)
    assert [job.stages for job in jobs] == [("ingest", "mesh"), ("export", "report")]
    assert jobs[1].needs == (jobs[0].id,) and jobs[0].needs == ()
    assert "--store" not in jobs[0].command and all(job.minutes >= 10 for job in jobs)


def test_captures_of_one_name_are_refused(run: Run, make_capture: Make, tmp_path: Path) -> None:
    twin = tmp_path / "elsewhere" / "one" / "images"
    twin.mkdir(parents=True)
    end = run("plan", make_capture("one"), twin.parent)
    assert end.code == 2 and "same name 'one'" in end.err


def test_folders_of_the_users_are_refused(run: Run, make_capture: Make, tmp_path: Path) -> None:
    """Output folders that are the captures themselves, and a folder `.batch` of another program."""
    scans = [make_capture("one"), make_capture("two")]
    before = sorted(tmp_path.rglob("*"))
    for command in ("plan", "batch"):
        end = run(command, *scans, "--out", tmp_path / "captures")
        assert end.code == 2 and end.err.count("\n") == 1 and "holds other files (images)" in end.err
    assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "root" / ".batch").mkdir(parents=True)
    (tmp_path / "root" / ".batch" / "payroll.csv").write_text("mine")
    end = run("batch", *scans, "--out", tmp_path / "root")
    assert end.code == 2 and "payroll.csv" in end.err and [p.name for p in (tmp_path / "root").rglob("*")] == [".batch", "payroll.csv"]


def test_a_result_that_was_published_beside_an_edited_one_counts(run: Run, make_capture: Make, tmp_path: Path) -> None:
    capture, out = make_capture("one"), tmp_path / "out" / "one"
    options = BatchOptions(tmp_path / "out", "smoke")
    run("run", capture, "--profile", "smoke")
    (out / "asset.glb").write_text("edited")
    run("run", capture, "--profile", "smoke")
    (plan,) = plan_captures([capture], options)
    assert plan.done and plan.files["asset.glb"] == out / "asset.new.glb"
    (out / "asset.new.glb").unlink()
    (out / "asset.glb").unlink()
    (plan,) = plan_captures([capture], options)
    assert not plan.done and not plan.to_run and [job.stages for job in make_jobs([plan], options, History(), threads=1)] == [("report",)]


@pytest.mark.parametrize("stage", ORDER)
def test_estimates_grow_with_the_work(stage: str) -> None:
    small, large = PhotoSet(20, 0.2), PhotoSet(200, 12.0)
    assert formula(stage, small, {}) <= formula(stage, large, {})
    assert all(value > 0 for value in formula(stage, PhotoSet(0, 0.0), {}))
    assert formula("bake", small, {"bake.size": 512})[0] < formula("bake", small, {"bake.size": 2048})[0]


def test_earlier_runs_correct_the_estimates() -> None:
    photos, settings = PhotoSet(40, 1.0), {"train.iterations": 1000}
    history = History()
    guess = history.estimate("train", photos, settings, 2)
    seconds, memory = formula("train", photos, settings)
    manifest = {"settings": settings, "seconds": 3 * seconds, "peak_bytes": int(2e6 * memory), "threads": 2}
    history.add("train", photos, {**manifest, "settings": {"train.iterations": 5}, "seconds": 50 * seconds})
    history.add("train", photos, manifest)
    history.add("train", photos, {**manifest, "seconds": 1.0, "resumed": True})
    better = history.estimate("train", photos, settings, 2)  # of the one run with the same settings
    assert better.measured == 1 and guess.measured == 0
    assert abs(better.seconds - 3 * guess.seconds) < 1e-9 and better.memory_mb >= 2 * memory
    assert history.estimate("train", photos, settings, 1).seconds == at_threads(3 * seconds, 1) > better.seconds


def test_the_shell_script_goes_on_after_a_failure(tmp_path: Path) -> None:
    tool, log = tmp_path / "gsbake", tmp_path / "log"
    tool.write_text(f'#!/bin/sh\necho "$2" >> {shlex.quote(str(log))}\ncase "$2" in */bad) exit 42;; esac\n')
    tool.chmod(0o755)
    jobs = [job(0, "mesh", name="bad"), job(1, "bake", ("c0000_mesh",), name="bad"), job(2, name="it's good")]
    script = emit("sh", jobs)
    done = subprocess.run(["sh", "-c", script], env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}, check=False, timeout=60)
    assert done.returncode == 1 and log.read_text().splitlines() == ["/photos/bad", "/photos/it's good"]


def test_slurm_jobs_wait_for_each_other(tmp_path: Path) -> None:
    tool, log = tmp_path / "sbatch", tmp_path / "log"
    tool.write_text(f'#!/bin/sh\nprintf "%s\\n" "$*" >> {shlex.quote(str(log))}\nwc -l < {shlex.quote(str(log))}\n')
    tool.chmod(0o755)
    script = emit("slurm", [job(0, "mesh"), job(0, "bake", ("c0000_mesh",))])
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run(["sh", "-c", script], env=environment, check=True, timeout=60)
    first, second = log.read_text().splitlines()
    assert "--mem=900M" in first and "--cpus-per-task=2" in first and "afterok" not in first
    assert "--dependency=afterok:1 " in second and "scontrol requeue" in second


def test_opencue_lines_are_whole_captures() -> None:
    lines = emit("opencue", [job(0, "mesh"), job(0, "bake", ("c0000_mesh",)), job(1, "mesh")]).splitlines()
    assert [shlex.split(line).count("gsbake") for line in lines] == [2, 1]


@pytest.mark.parametrize("count", [3, 150])
def test_openjd_template_is_valid(count: int) -> None:
    model = pytest.importorskip("openjd.model")
    jobs = [job(n // 2, "bake" if n % 2 else "mesh", (f"c{n // 2:04d}_mesh",) if n % 2 else ()) for n in range(count)]
    template = model.decode_job_template(template=json.loads(as_openjd(jobs)))
    assert len(template.steps) == (3 if count == 3 else 1)
    if count == 3:
        assert template.steps[1].dependencies[0].dependsOn == "c0000_mesh"
    with pytest.raises(UsageError, match="rename"):
        as_openjd([job(0, name="{{x}}")])


def test_an_unknown_format_is_named(run: Run, make_capture: Make) -> None:
    end = run("plan", make_capture("one"), "--emit", "tractor")
    assert end.code == 2 and ", ".join(FORMATS) in end.err
