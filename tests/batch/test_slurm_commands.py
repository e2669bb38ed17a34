"""What the coordinator asks Slurm, with commands that answer as Slurm does; on a real Slurm: tests/slurm."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from gsbake.batch import slurm, workflow
from gsbake.batch.jobs import Job
from gsbake.batch.records import Record, RecordReader
from gsbake.batch.slurm import Cluster, SlurmOptions
from gsbake.batch.workflow import Execution
from gsbake.errors import UsageError
from tests.cli.conftest import Run

Fake = Callable[..., None]
CONFIG = "Configuration data as of now\nAccountingStorageType = {}\nMinJobAge = 300 sec\nPriorityType = {}\n"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Write a command that prints a text, or runs a script; only fakes and the system's own commands are on the PATH."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:/bin")

    def write(name: str, text: str = "", script: str = "") -> None:
        (folder / f"{name}.txt").write_text(text)
        (folder / name).write_text(f"#!/bin/sh\n{script or f'cat {folder / name}.txt'}\n")
        (folder / name).chmod(0o755)

    return write


@pytest.mark.parametrize(
    ("storage", "priority", "command", "nice"),
    [("accounting_storage/none", "priority/basic", "squeue", 200), ("accounting_storage/slurmdbd", "priority/multifactor", "sacct", 1)],
)
def test_a_cluster(fake: Fake, storage: str, priority: str, command: str, nice: int) -> None:
    for name in ("sbatch", "sacct"):
        fake(name)
    fake("scontrol", CONFIG.format(storage, priority))
    fake("sinfo", "n1 6000 4\nn2 24000+ 16\nn2 24000+ 16\n")  # a node of two partitions is listed twice
    assert slurm.ask_cluster(SlurmOptions()) == Cluster(command, 2, 24000, 20, nice)


def test_a_cluster_that_cannot_be_used(fake: Fake) -> None:
    fake("sbatch", script="exit 1")
    fake("scontrol", script="exit 1")
    fake("sinfo", "")
    with pytest.raises(UsageError, match="does not answer"):
        slurm.ask_cluster(SlurmOptions())
    fake("scontrol", CONFIG.format("(null)", "priority/basic"))
    with pytest.raises(UsageError, match="no nodes in the partition night"):
        slurm.ask_cluster(SlurmOptions(partition="night"))


def test_jobs_of_the_batch_are_found_and_cancelled(fake: Fake, tmp_path: Path) -> None:
    prefix = slurm.job_prefix(tmp_path)
    assert prefix == slurm.job_prefix(tmp_path / ".") != slurm.job_prefix(tmp_path / "other")
    jobs = tmp_path / "bin" / "squeue.txt"
    fake("squeue", f"7 {prefix}_a\n8 other\n9 {prefix}_b\n", f"cat {jobs}")
    fake("scancel", script=f'echo "$@" >> {tmp_path}/cancelled; : > {jobs}')
    assert slurm.queued_jobs(prefix) == ["7", "9"]
    slurm.cancel_jobs(prefix)
    assert (tmp_path / "cancelled").read_text() == "7 9\n" and slurm.queued_jobs(prefix) == []
    fake("squeue", script="exit 1")
    assert slurm.queued_jobs(prefix) is None


def test_a_queue_that_stays_empty_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now, answer = [0.0], [[]]
    monkeypatch.setattr(workflow.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(slurm, "queued_jobs", lambda prefix: answer[0])
    queue = workflow._Queue("x")

    def after(seconds: float, jobs: list[str] | None, settled: bool = False) -> bool:
        now[0] += seconds
        answer[0] = jobs  # type: ignore[assignment]
        return queue.abandoned(settled)

    assert not after(500.0, [])  # Snakemake is still preparing
    assert not after(10.0, ["1"])
    assert not after(30.0, []) and not after(20.0, None)  # slurmctld does not answer: nothing is known
    assert not after(50.0, []) and after(50.0, [])
    assert not after(10.0, ["2"], settled=True) and after(10.0, [], settled=True)  # all have ended: at once


def test_the_document_of_the_jobs(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsbake.batch.captures import BatchOptions

    job = Job("c0_x", "x", "/p", "/o", ("mesh",), (), (), 1, 9000, 60.0, 10)
    cluster = Cluster("squeue", 2, 6000, 8, 200)
    execution = Execution(8, cluster, SlurmOptions("night", "studio"), 32)
    arguments = workflow._prepare([job], BatchOptions(tmp_path, "smoke"), execution, tmp_path, "gsbake-1")
    document = json.loads((tmp_path / "jobs.json").read_text())
    assert document["jobs"][0]["memory_mb"] == 6000 and document["nodes"] == 2 and document["nice"] == 200
    assert document["resources"] == {"slurm_partition": "night", "slurm_account": "studio"}
    assert arguments[arguments.index("--jobs") + 1] == "32" and "--slurm-requeue" in arguments


def test_records_are_read_once(tmp_path: Path) -> None:
    reader = RecordReader(tmp_path)
    assert reader.new_records() == []
    first = Record("a", "c0_a", 75, "The power failed.", 1.0, "n1", "2026-01-01T00:00:00", "k", ("n1",))
    first.write(tmp_path)
    assert reader.new_records() == [first] and reader.new_records() == []
    second = Record("a", "c0_a", 0, "", 2.0, "n2", "2026-01-01T00:01:00", "", ("n1",))
    Record("b", "c1_b", 42, "Bad.", 1.0, "n2", "2026-01-01T00:02:00", "k").write(tmp_path)
    second.write(tmp_path)
    os.utime(tmp_path / ".batch" / "records")
    assert [r.capture for r in reader.new_records()] == ["a", "b"]
    progress = workflow._Progress([Job(name, name[-1], "", "", (), (), (), 1, 1, 1.0, 1) for name in ("c0_a", "c1_b", "c1x_b", "c2_c")])
    passed: list[Record] = []
    progress.take([first], passed.append)
    assert not progress.settled and passed == [first]
    progress.take(
        [second, Record("b", "c1_b", 42, "Bad.", 1.0, "n2", "", "k"), Record("c", "c2_c", 0, "", 1.0, "n2", "", "")], passed.append
    )
    assert progress.settled and progress.records == 4  # the later job of b is not waited for
