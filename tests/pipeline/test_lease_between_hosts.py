"""Leases where kernel locks do not carry: two hosts that share a folder, simulated by leases without the lock."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from gsbake.errors import InterruptedRun
from gsbake.pipeline import lease as module
from gsbake.pipeline.lease import Lease, LeaseHolder
from tests.pipeline.toy import engine


class NoLock:
    """A kernel lock that every host gets."""

    def acquire(self, timeout: float = 0) -> None:
        """Always granted."""

    def release(self) -> None:
        """Nothing to do."""


@pytest.fixture
def hosts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every thread is a host of its own, with its own process id."""
    monkeypatch.setattr(module.socket, "gethostname", lambda: f"host-{threading.get_ident()}")
    monkeypatch.setattr(module.os, "getpid", threading.get_ident)


def unlocked(path: Path, timeout: float = 0.3) -> Lease:
    lease = Lease(path, heartbeat_interval=0.05, heartbeat_timeout=timeout)
    lease._lock = NoLock()  # type: ignore[assignment]
    return lease


@pytest.mark.usefixtures("hosts")
@pytest.mark.parametrize("stale", [False, True])
def test_one_of_two_hosts_gets_the_lease(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stale: bool) -> None:
    monkeypatch.setattr(module.psutil, "Process", lambda *_: type("P", (), {"create_time": staticmethod(lambda: 1.0)})())
    for turn in range(20):
        path = tmp_path / f"{turn}.lease"
        if stale:
            path.write_text(json.dumps(asdict(LeaseHolder("gone", "b", 1, 0.0, token="old"))))
        inside, most = [0], [0]
        start = threading.Barrier(4)

        def work(path: Path = path, inside: list[int] = inside, most: list[int] = most, start: threading.Barrier = start) -> None:
            lease = unlocked(path)
            start.wait()
            lease.acquire(poll=0.01)
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            time.sleep(0.02)
            inside[0] -= 1
            lease.release()

        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
        assert most == [1], f"round {turn}"
        assert not path.exists()


def test_release_leaves_another_holders_lease(tmp_path: Path) -> None:
    lease = unlocked(tmp_path / "x.lease")
    lease.acquire()
    thief = LeaseHolder("elsewhere", "b", 1, 0.0, token="thief")
    lease.path.write_text(json.dumps(asdict(thief)))
    time.sleep(0.2)
    assert not lease.held() and LeaseHolder.read(lease.path) == thief  # no heartbeat writes over it
    lease.release()
    assert LeaseHolder.read(lease.path) == thief


def test_a_run_that_lost_its_lease_publishes_nothing(tmp_path: Path, photos: Path) -> None:
    out = tmp_path / "out"
    run, recorder = engine(out, photos)
    relay = run._relay

    def steal(name: str, message: object) -> None:
        relay(name, message)  # type: ignore[arg-type]
        if name == "sum":
            path = next((out / "stages" / "sum").glob("*.lease"))
            path.write_text(json.dumps(asdict(LeaseHolder("elsewhere", "b", 1, 0.0, token="thief"))))

    run._relay = steal  # type: ignore[method-assign,assignment]
    with pytest.raises(InterruptedRun, match="took over the lease"):
        run.run()
    assert recorder.ran == ["read"]
