"""Which jobs of a batch start first."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from gsbake.batch import workflow
from gsbake.batch.captures import BatchOptions
from gsbake.batch.jobs import LEVELS, Job, start_levels
from gsbake.python_process import python_command, python_environment


def job(name: str, seconds: float, *needs: str) -> Job:
    return Job(name, name[0], "/p", "/o", ("mesh",), (), needs, 1, 100, seconds, 10)


def test_levels_follow_what_is_left_of_a_capture() -> None:
    jobs = [job("a1", 100.0), job("a2", 50.0, "a1"), job("b1", 120.0), job("c1", 10.0), job("c2", 500.0, "c1")]
    found = start_levels(jobs)
    assert sorted(found, key=lambda name: found[name]) == ["c1", "c2", "a1", "b1", "a2"]
    assert found["c1"] == 0 and max(found.values()) < LEVELS


def test_levels_are_of_equal_size_and_equal_jobs_share_one() -> None:
    found = start_levels([job(f"j{n}", float(n)) for n in range(10 * LEVELS)])
    counts = [list(found.values()).count(level) for level in range(LEVELS)]
    assert counts == [10] * LEVELS and found[f"j{10 * LEVELS - 1}"] == 0 and found["j0"] == LEVELS - 1
    assert set(start_levels([job(f"j{n}", 5.0) for n in range(40)]).values()) == {0} and not start_levels([])


def test_the_longest_captures_start_first(tmp_path: Path) -> None:
    pytest.importorskip("snakemake")
    jobs = [job(f"{name}1", seconds) for name, seconds in zip("abcdef", (30.0, 90.0, 10.0, 70.0, 50.0, 20.0), strict=True)]
    jobs.append(job("b2", 40.0, "b1"))
    work = tmp_path / "a #b"  # in no argument of Snakemake, which would read it as YAML
    work.mkdir()
    arguments = workflow._prepare(jobs, BatchOptions(work, "smoke"), workflow.Execution(1), work, "unused")
    document = json.loads((work / "jobs.json").read_text())
    for row in document["jobs"]:
        row["shell"] = f"echo {row['id']} >> {tmp_path / 'log'}"
    (work / "jobs.json").write_text(json.dumps(document))
    done = subprocess.run(
        python_command("-m", "snakemake", *arguments), cwd=work, env=python_environment(), capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "log").read_text().split() == ["b1", "d1", "e1", "b2", "a1", "f1", "c1"]
