"""`gsbake batch --executor slurm` on a real Slurm, with faults.

All captures end with the bytes of plain runs, and nothing that was finished is computed again.
"""

from __future__ import annotations

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

from tests.slurm.batches import Batch, events, stages, start_batch
from tests.slurm.cluster import Cluster

pytestmark = [pytest.mark.stress, pytest.mark.timeout(6 * 3600)]
Plain = dict[str, dict[str, str]]


def wait_for_training(batch: Batch) -> Path:
    """Wait until a capture is being trained; returns it."""
    batch.wait_until("training", lambda: any(batch.runs(path, "train") for path in batch.captures))
    time.sleep(3.0)
    return next((path for path in batch.captures if batch.runs(path, "train")), batch.captures[0])


def node_of(cluster: Cluster) -> str:
    """A node with a running job."""
    return next(node for node in cluster.nodes if cluster.running_on(node))


def tell(capsys: pytest.CaptureFixture[str], text: str) -> None:
    with capsys.disabled():
        sys.stdout.write(f"\n{text}\n")


def test_a_node_is_killed(cluster: Cluster, captures: list[Path], plain: Plain, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    batch = start_batch(captures, tmp_path / "out", cluster.environment)
    wait_for_training(batch)
    node = node_of(cluster)
    cluster.kill_node(node)
    batch.finish()
    assert cluster.node_states()[node].startswith(("down", "idle*", "alloc*", "mix*"))
    tell(capsys, f"node killed: {batch.check(plain)} stages lost")


def test_a_job_is_preempted(
    cluster: Cluster, captures: list[Path], plain: Plain, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    batch = start_batch(captures, tmp_path / "out", cluster.environment)
    capture = wait_for_training(batch)
    for node in cluster.nodes:
        cluster.call("sbatch", "--partition=urgent", f"--nodelist={node}", "--output=/dev/null", "--wrap", "sleep 5")
    batch.wait_until("the pre-emption", lambda: "stop sent" in {event["event"] for event in events(batch.root / capture.name)})
    batch.finish()
    tell(capsys, f"pre-empted: {batch.check(plain)} stages interrupted")
    assert any(event["event"] == "stop sent" for path in captures for event in events(batch.root / path.name))


def test_a_node_has_a_full_disk(cluster: Cluster, captures: list[Path], plain: Plain, tmp_path: Path) -> None:
    """Its jobs end with 75 at once and are tried again on the other node only."""
    root = tmp_path / "out"
    cluster.kill_node("node2")
    cluster.start_node("node2", full=[root / path.name for path in captures])
    batch = start_batch(captures, root, cluster.environment)
    batch.finish()
    batch.check(plain)
    log = (root / ".batch" / "snakemake.log").read_text()
    assert "--exclude=node2" in log and "--exclude=node1" not in log


@pytest.fixture
def object_server() -> Iterator[tuple[subprocess.Popen[bytes], dict[str, str]]]:
    """An object server in a process of its own, and the variables with which it is reached."""
    pytest.importorskip("moto.server")
    pytest.importorskip("s3fs")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", "from moto.server import main; main()", "-H", "127.0.0.1", "-p", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    keys = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x"}
    keys["AWS_DEFAULT_REGION"] = "us-east-1"
    script = "import s3fs; s3fs.S3FileSystem().mkdir('farm')"
    for _ in range(60):
        time.sleep(1.0)
        if subprocess.run([sys.executable, "-c", script], env={**os.environ, **keys}, capture_output=True, check=False).returncode == 0:
            break
    yield process, keys
    process.send_signal(signal.SIGCONT)
    process.kill()
    process.wait()


def test_the_store_does_not_answer_for_a_minute(
    cluster: Cluster, captures: list[Path], plain: Plain, object_server: tuple[subprocess.Popen[bytes], dict[str, str]], tmp_path: Path
) -> None:
    server, keys = object_server
    environment = {**cluster.environment, **keys}
    batch = start_batch(captures, tmp_path / "out", environment, "--store", "s3://farm/cache")
    wait_for_training(batch)
    server.send_signal(signal.SIGSTOP)
    time.sleep(60.0)
    server.send_signal(signal.SIGCONT)
    batch.finish()
    assert batch.check(plain) == 0
    again = start_batch(captures, tmp_path / "again", environment, "--store", "s3://farm/cache")  # the store has all stages
    again.finish()
    again.check(plain)
    assert not any(stages(tmp_path / "again" / path.name, "stage started") for path in captures)


@pytest.mark.parametrize("with_snakemake", [False, True])
def test_the_coordinator_is_killed(cluster: Cluster, captures: list[Path], plain: Plain, tmp_path: Path, with_snakemake: bool) -> None:
    batch = start_batch(captures, tmp_path / "out", cluster.environment)
    wait_for_training(batch)
    for process in [*(psutil.Process(batch.process.pid).children() if with_snakemake else ()), batch.process]:
        os.kill(process.pid, signal.SIGKILL)
    batch.process.wait()
    assert cluster.jobs()
    again = start_batch(captures, tmp_path / "out", cluster.environment)
    again.finish()
    again.check(plain)
    assert not cluster.jobs()


def test_the_controller_is_killed(cluster: Cluster, captures: list[Path], plain: Plain, tmp_path: Path) -> None:
    """While slurmctld does not answer, Snakemake forgets its jobs; the batch goes on when it answers again."""
    batch = start_batch(captures, tmp_path / "out", cluster.environment)
    wait_for_training(batch)
    cluster.kill_controller()
    time.sleep(90.0)
    cluster.start_controller()
    batch.finish()
    batch.check(plain)
