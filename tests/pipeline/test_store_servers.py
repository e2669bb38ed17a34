"""Servers that hold a shared store and fail: killed in the middle of puts, unknown, or away for a while."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsbake.errors import UsageError
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.shared_store import SharedStore, open_shared_store
from gsbake.pipeline.store import Artifact, Store
from gsbake.python_process import python_command, python_environment
from tests.support.ssh_server import SshServer
from tests.support.swift_server import ServerUnavailable, SwiftServer

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]
COUNT, BYTES = 24, 400_000


def artifacts(out: Path, count: int, size: int) -> list[tuple[CacheKey, Artifact]]:
    """Artifacts of two files each, one of them of `size` random bytes, with their keys."""
    local, made, rng = Store(out), [], random.Random(3)
    for number in range(count):
        key = CacheKey("sum", 1, {}, {"words": str(number)})
        temporary = local.temporary("sum", key.digest)
        (temporary / "total.txt").write_text(f"total {number}")
        (temporary / "noise.bin").write_bytes(rng.randbytes(size))
        manifest = {"stage": "sum", "key": key.digest, "settings": {}}
        made.append((key, local.publish(temporary, local.folder("sum", key.digest), manifest)))
    return made


def opened(url: str, patience: float) -> SharedStore:
    found = open_shared_store(url, patience)
    assert found is not None
    return found


def check(store: SharedStore, made: list[tuple[CacheKey, Artifact]], folder: Path) -> int:
    """Assert that every artifact that the store has is whole and intact, and nothing else is there; returns how many it has."""
    found = 0
    for number, (key, artifact) in enumerate(made):
        target = folder / str(number)
        target.mkdir(parents=True)
        manifest = store.fetch(key, target)
        if manifest is not None:
            found += 1
            for name in artifact.files:
                assert (target / name).read_bytes() == (artifact.folder / name).read_bytes()
    assert not store.damaged and not store.verify(folder).damaged
    return found


@pytest.fixture(scope="module")
def swift(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SwiftServer]:
    """An object server that keeps what it stored when it is killed."""
    pytest.importorskip("s3fs")
    server = SwiftServer(tmp_path_factory.mktemp("swift"))
    try:
        server.__enter__()
    except ServerUnavailable as error:
        pytest.skip(f"no object server can be started here: {error}")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in server.environment.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem(skip_instance_cache=True).mkdir("farm")
        yield server
    server.kill()


def test_an_object_server_that_is_killed_in_the_middle_of_puts(swift: SwiftServer, tmp_path: Path) -> None:
    """The puts wait until it is back; everything is there then, and nothing is damaged."""
    made = artifacts(tmp_path / "out", COUNT, BYTES)
    store = opened("s3://farm/patient", 300.0)
    kills, ended = 0, threading.Event()

    def put_all() -> None:
        try:
            for _, artifact in made:
                assert store.put(artifact) is None
        finally:
            ended.set()

    thread = threading.Thread(target=put_all)
    thread.start()
    rng = random.Random(7)
    while not ended.wait(rng.uniform(0.3, 1.5)) and kills < 4:
        swift.kill()
        kills += 1
        time.sleep(rng.uniform(0.0, 1.0))
        swift.start()
    thread.join()
    assert kills, "the puts were over before the first kill"
    assert check(opened("s3://farm/patient", 30.0), made, tmp_path / "fetched") == COUNT


def test_machines_and_the_object_server_are_killed_together(swift: SwiftServer, tmp_path: Path) -> None:
    """A power failure: what has an entry is whole; the next puts complete the rest."""
    made = artifacts(tmp_path / "out", COUNT, BYTES)
    script = (
        "import sys; from pathlib import Path\n"
        "from tests.pipeline.test_store_servers import artifacts, opened\n"
        f"made = artifacts(Path(sys.argv[1]), {COUNT}, {BYTES}); store = opened(sys.argv[2], 60.0); print('ready', flush=True)\n"
        "for _, artifact in made: store.put(artifact); print('one', flush=True)\n"
    )
    counts = []
    for turn in range(4):
        command = python_command("-c", script, str(tmp_path / f"own{turn}"), "s3://farm/power")
        with subprocess.Popen(command, env=python_environment(), stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            for _ in range(2 + 4 * turn):  # ready, and some artifacts
                process.stdout.readline()
            time.sleep(0.05 * (turn + 1))
            os.kill(process.pid, signal.SIGKILL)
            swift.kill()
        swift.start()
        counts.append(check(opened("s3://farm/power", 60.0), made, tmp_path / f"fetched{turn}"))
    assert counts == sorted(counts) and 0 < counts[-1] < COUNT
    store = opened("s3://farm/power", 60.0)
    assert all(store.put(artifact) is None for _, artifact in made)
    assert check(store, made, tmp_path / "all") == COUNT


def test_a_large_file_goes_in_parts(swift: SwiftServer, tmp_path: Path) -> None:
    made = artifacts(tmp_path / "out", 1, 120_000_000)
    store = opened("s3://farm/large", 60.0)
    assert store.put(made[0][1]) is None
    assert check(store, made, tmp_path / "fetched") == 1


def test_a_lost_connection_to_an_ssh_server_is_made_anew(ssh: SshServer, tmp_path: Path) -> None:
    made = artifacts(tmp_path / "out", 6, 100_000)
    found = open_shared_store(ssh.url(tmp_path / "shared"), 60.0)
    assert found is not None
    for number, (_, artifact) in enumerate(made):
        if number == 2:
            ssh.kill()
            threading.Timer(2.0, ssh.start).start()
        assert found.put(artifact) is None
    ssh.kill()
    ssh.start()
    assert check(found, made, tmp_path / "fetched") == 6


def test_an_ssh_server_that_is_not_known_is_refused(ssh: SshServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".ssh").mkdir()
    shutil.copy(ssh.home / ".ssh" / "id_ed25519", tmp_path / ".ssh")
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(UsageError, match="known_hosts; connect once with ssh"):
        open_shared_store(ssh.url(tmp_path / "shared"))
    other = subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(tmp_path / "other")], check=True)
    assert other.returncode == 0
    (tmp_path / ".ssh" / "known_hosts").write_text(f"[127.0.0.1]:{ssh.port} {(tmp_path / 'other.pub').read_text()}")
    with pytest.raises(UsageError, match="shows another key"):
        open_shared_store(ssh.url(tmp_path / "shared"))
