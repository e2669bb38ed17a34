"""The script of `gsbake plan --emit slurm` on a real Slurm.

Jobs wait for each other, an interrupted one is put into the queue again, and the jobs after one that failed are dropped. A stand-in for
gsbake notes its calls.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import time
from pathlib import Path

import pytest

from gsbake.batch.emit import emit
from gsbake.batch.jobs import Job
from tests.slurm.cluster import Cluster

pytestmark = [pytest.mark.stress, pytest.mark.timeout(1800)]


def job(capture: str, stage: str, needs: tuple[str, ...] = ()) -> Job:
    command = ("gsbake", stage, f"/photos/{capture}", "--quiet")
    return Job(f"{capture}_{stage}", capture, f"/photos/{capture}", "", (stage,), command, needs, 1, 100, 10.0, 10)


def test_the_script_on_a_cluster(cluster: Cluster, tmp_path: Path) -> None:
    tool, log = tmp_path / "gsbake", tmp_path / "log"
    tool.write_text(
        f'#!/bin/sh\necho "$1 $2" >> {shlex.quote(str(log))}\n'
        'case "$1 $2 ${SLURM_RESTART_COUNT:-0}" in "train /photos/flaky 0") exit 75;; "mesh /photos/bad "*) exit 42;; esac\n'
    )
    tool.chmod(0o755)
    jobs = [
        job("flaky", "train"), job("flaky", "mesh", ("flaky_train",)), job("bad", "mesh"), job("bad", "bake", ("bad_mesh",)),
        job("it_is", "mesh"),
    ]  # fmt: skip
    environment = {**cluster.environment, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run(["sh", "-c", emit("slurm", jobs)], env=environment, cwd=tmp_path, check=True, timeout=120)
    deadline = time.monotonic() + 1500
    while cluster.jobs() and time.monotonic() < deadline:
        time.sleep(1.0)
    calls = log.read_text().splitlines()
    assert sorted(calls) == ["mesh /photos/bad", "mesh /photos/flaky", "mesh /photos/it_is", "train /photos/flaky", "train /photos/flaky"]
    assert calls.index("mesh /photos/flaky") > max(k for k, call in enumerate(calls) if call == "train /photos/flaky")
