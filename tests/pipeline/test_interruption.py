"""Kills, signals and concurrent runs: the same command resumes and gives a complete result."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.system.limits import boot_id
from tests.pipeline.test_engine import total
from tests.pipeline.toy import Sum, Toy, engine

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[str]]]:
    """Processes that a test started; killed at its end."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        process.kill()
        process.communicate()


def start(processes: list[subprocess.Popen[str]], *arguments: object) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", "from tests.pipeline.toy import main; main()", *map(str, arguments)],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    processes.append(process)
    return process


def wait_for(out: Path, pattern: str, seconds: float = 20.0) -> Path:
    """Wait for a file under `out` that matches, and return it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for path in out.glob(pattern):
            return path
        time.sleep(0.02)
    raise AssertionError(f"{pattern} did not appear in {out}")


def steps_done(out: Path) -> int:
    return int(json.loads(wait_for(out, "stages/sum/*.checkpoint/state.json").read_text())["step"])


def wait_until_step(out: Path, step: int) -> None:
    end = time.monotonic() + 20
    while steps_done(out) < step:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_run_resumes_after_kill(tmp_path: Path, photos: Path, started: list[subprocess.Popen[str]]) -> None:
    out = tmp_path / "out"
    process = start(started, out, photos, "chain", 60, 0.05)
    wait_until_step(out, 5)
    workers = psutil.Process(process.pid).children()
    process.kill()
    process.communicate()
    gone, alive = psutil.wait_procs(workers, timeout=5)
    assert gone and not alive  # the worker ends with its supervisor
    assert list((out / "stages" / "sum").glob("*.tmp-*"))
    assert not list((out / "stages" / "tell").glob("*")) if (out / "stages" / "tell").exists() else True
    reached = steps_done(out)
    again, seen = engine(out, photos, Toy(sum=Sum(steps=60, step_seconds=0.05)))
    assert [s.status for s in again.plan()] == ["cached", "run", "waits"]
    begin = time.monotonic()
    states = again.run()
    manifest = states[1].artifact.manifest  # type: ignore[union-attr]
    assert seen.cached == ["read"] and seen.ran == ["sum", "tell"]
    assert manifest["results"] == {"total": total(60, 3)} and manifest["resumed"]
    assert seen.reports[0][0] == reached + 1 and time.monotonic() - begin < 30
    left = [p.name for p in (out / "stages" / "sum").iterdir() if not p.name.startswith(".")]
    assert left == [states[1].artifact.folder.name]  # type: ignore[union-attr]


def test_killed_worker_is_reported_as_interruption(tmp_path: Path, photos: Path, started: list[subprocess.Popen[str]]) -> None:
    out = tmp_path / "out"
    process = start(started, out, photos, "chain", 200, 0.05)
    wait_until_step(out, 3)
    psutil.Process(process.pid).children()[0].kill()
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 75
    assert "killed by the system" in errors and "Traceback" not in errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_with_exit_code_75(tmp_path: Path, photos: Path, started: list[subprocess.Popen[str]], number: signal.Signals) -> None:
    out = tmp_path / "out"
    process = start(started, out, photos, "chain", 500, 0.05)
    wait_until_step(out, 3)
    begin = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 75 and time.monotonic() - begin < 4
    assert errors.startswith("Sum slowly: Stopped on request") and errors.count("\n") == 0
    assert not list((out / "stages" / "sum").glob("*.tmp-*")) and not list((out / "stages" / "sum").glob("*.lease"))
    assert steps_done(out) >= 3


def test_second_signal_kills_the_stage(tmp_path: Path, photos: Path, started: list[subprocess.Popen[str]]) -> None:
    out = tmp_path / "out"
    process = start(started, out, photos, "stubborn")
    wait_for(out, "stages/stubborn/*.tmp-*/half.txt")
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)  # the second signal does not wait for the timeout
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 75 and time.monotonic() - begin < 4 and "Killed on request" in errors
    assert not [p for p in (out / "stages" / "stubborn").iterdir() if not p.name.startswith(".")]


@pytest.mark.slow
def test_stage_is_killed_after_the_timeout(tmp_path: Path, photos: Path, started: list[subprocess.Popen[str]]) -> None:
    process = start(started, tmp_path / "out", photos, "stubborn")
    wait_for(tmp_path / "out", "stages/stubborn/*.tmp-*/half.txt")
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 75 and 4 < time.monotonic() - begin < 8


def test_concurrent_runs_share_one_computation(tmp_path: Path, photos: Path, started: list[subprocess.Popen[str]]) -> None:
    out = tmp_path / "out"
    first = start(started, out, photos, "chain", 40, 0.05)
    wait_until_step(out, 2)
    second = start(started, out, photos, "chain", 40, 0.05)
    ends = [json.loads(p.communicate(timeout=40)[0]) for p in (first, second)]
    assert ends[0]["ran"] == ["read", "sum", "tell"]
    assert "sum" not in ends[1]["ran"] and "sum" in ends[1]["cached"]
    assert f"process {first.pid} on " in ends[1]["waited"][0]


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.parametrize(
    "holder",
    [
        LeaseHolder(socket.gethostname(), boot_id(), dead_pid(), time.time() - 100),
        LeaseHolder(socket.gethostname(), boot_id(), os.getpid(), 12345.0),  # same pid, another process
    ],
    ids=["dead process", "recycled pid"],
)
def test_stale_lease_is_taken_over(tmp_path: Path, holder: LeaseHolder) -> None:
    lease = Lease(tmp_path / "x.lease")
    lease.path.write_text(json.dumps(holder.__dict__))
    waited: list[object] = []
    assert lease.acquire(waited.append) == holder
    assert waited == []
    assert LeaseHolder.read(lease.path).pid == os.getpid()  # type: ignore[union-attr]
    lease.release()
    assert not lease.path.exists()


@pytest.mark.parametrize("host", ["another-host", socket.gethostname()], ids=["another host", "cloned machine"])
def test_lease_of_another_host_or_boot_is_stale_without_heartbeats(tmp_path: Path, host: str) -> None:
    lease = Lease(tmp_path / "x.lease", heartbeat_timeout=0.6)
    holder = LeaseHolder(host, "another boot", 1, 0.0, beat=3)
    lease.path.write_text(json.dumps(holder.__dict__))
    beats = iter(range(4, 7))

    def beat(_: LeaseHolder | None) -> None:
        number = next(beats, None)
        if number is not None:  # three more heartbeats, then none
            lease.path.write_text(json.dumps({**holder.__dict__, "beat": number}))

    begin = time.monotonic()
    taken = lease.acquire(beat)
    lease.release()
    assert taken is not None and taken.beat == 6
    assert time.monotonic() - begin > 1.0  # three polls with heartbeats, then the timeout


def test_lease_sends_heartbeats_and_replaces_an_unreadable_file(tmp_path: Path) -> None:
    lease = Lease(tmp_path / "x.lease", heartbeat_interval=0.05)
    lease.path.write_text("{half a")
    assert lease.acquire() is None
    time.sleep(0.4)
    assert LeaseHolder.read(lease.path).beat >= 2  # type: ignore[union-attr]
    lease.release()
