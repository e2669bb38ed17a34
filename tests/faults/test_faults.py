"""Faults on the real pipeline: kills, damaged files, full and failing disks, clock jumps, runs at once.

After each fault the same command ends with the bytes of an undisturbed run, or refuses with one documented sentence. A short part runs
with the quick tests, the long part with `make stress`; both print their count.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from tests.faults.bake import SIGNALS, STAGES, TIMEOUT, Reference, bake, command, damage, digests, interrupted, work_files

KINDS = ("truncate", "flip", "empty", "delete", "plant")
PRELOAD = Path(__file__).with_name("failing_writes.c")


def tell(capsys: pytest.CaptureFixture[str], title: str, outcomes: Counter[str]) -> None:
    """Print the count of a series."""
    with capsys.disabled():
        sys.stdout.write(f"\n{title}: {sum(outcomes.values())} faults, {dict(outcomes)}\n")


def kills(reference: Reference, folder: Path, count: int, seed: int) -> Counter[str]:
    rng, outcomes = random.Random(seed), Counter[str]()
    for turn in range(count):
        stage, name, child = rng.choice(STAGES), rng.choice(sorted(SIGNALS)), rng.random() < 0.5
        out = reference.unfinished(folder / str(turn), stage)
        seconds = rng.uniform(0.2, 1.0) * reference.seconds * rng.random()
        end = interrupted(reference.capture, out, SIGNALS[name], seconds, child)
        what = f"{name} {'in a child ' if child else ''}{seconds:.1f} s after {stage} (turn {turn}, seed {seed})"
        assert end.code in (0, 75, -9, -15), f"{what}: exit {end.code}\n{end.text[-2000:]}"
        outcome = reference.check(out, what)
        assert outcome == "recovered", what
        outcomes[outcome] += 1
        shutil.rmtree(out)
    return outcomes


def damages(reference: Reference, folder: Path, count: int, seed: int, stages: tuple[str, ...] = ()) -> Counter[str]:
    rng, outcomes = random.Random(seed), Counter[str]()
    for turn in range(count):
        out = reference.copy(folder / str(turn))
        places = [(path, path.relative_to(out).parts) for path in work_files(out)]
        files = [path for path, parts in places if not stages or parts[0] != "stages" or parts[1] in stages]
        path, kind = rng.choice(files), rng.choice(KINDS)
        damage(path, kind, rng)
        outcomes[reference.check(out, f"{kind} {path.relative_to(out)} (turn {turn}, seed {seed})")] += 1
        shutil.rmtree(out)
    return outcomes


@pytest.mark.slow
@pytest.mark.timeout(900)  # its fixture is a whole bake, on a fresh machine with the compilation of all kernels
def test_a_few_kills(reference: Reference, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tell(capsys, "kills", kills(reference, tmp_path, 1, 1))


@pytest.mark.slow
def test_a_few_damaged_files(reference: Reference, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tell(capsys, "damaged files", damages(reference, tmp_path, 4, 2, ("ingest", "poses", "export", "report")))


@pytest.mark.slow
def test_clock_jumps(reference: Reference, tmp_path: Path) -> None:
    """Files from the future and from the past are the same files."""
    out = reference.copy(tmp_path / "shifted")
    for path in work_files(out):
        shift = 400 * 86400 * (1 if len(path.name) % 2 else -1)
        os.utime(path, (path.stat().st_atime + shift, path.stat().st_mtime + shift))
    assert reference.check(out, "clock jumps") == "recovered"


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("seed", range(10))
def test_many_kills(reference: Reference, tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int) -> None:
    tell(capsys, "kills", kills(reference, tmp_path, 10, 100 + seed))


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("seed", range(10))
def test_many_damaged_files(reference: Reference, tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int) -> None:
    tell(capsys, "damaged files", damages(reference, tmp_path, 20, 200 + seed))


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("processes", [2, 4])
def test_runs_at_once(reference: Reference, tmp_path: Path, processes: int) -> None:
    """On one folder: the work is done once. On separate folders with one empty kernel cache: all have the same bytes."""
    together = [subprocess.Popen(command(reference.capture, tmp_path / "one")) for _ in range(processes)]
    assert [p.wait(timeout=TIMEOUT) for p in together] == [0] * processes
    assert digests(tmp_path / "one") == reference.files
    cache = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    apart = [subprocess.Popen(command(reference.capture, tmp_path / f"own{i}"), env=cache) for i in range(processes)]
    assert [p.wait(timeout=TIMEOUT) for p in apart] == [0] * processes
    assert all(digests(tmp_path / f"own{i}") == reference.files for i in range(processes))


@pytest.mark.slow
@pytest.mark.timeout(5400)
def test_interrupted_first_compilation(reference: Reference, tmp_path: Path) -> None:
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    out = reference.unfinished(tmp_path / "out", "train")
    for seconds in (3.0, 6.0, 9.0):
        process = subprocess.Popen(command(reference.capture, out), env={**os.environ, **cache})
        time.sleep(seconds)
        process.kill()
        process.wait()
    end = bake(reference.capture, out, cache)
    assert end.code == 0, end.text
    assert digests(out) == reference.files


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="mounting a small disk needs root")
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8, 0.95])
def test_full_disk(reference: Reference, tmp_path: Path, share: float) -> None:
    """A disk that has room for a share of the output: exit 75, and with more room the same command finishes."""
    need = sum(path.stat().st_size for path in work_files(reference.out))
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={int(share * need)}", "tmpfs", str(disk)], check=False).returncode:
        pytest.skip("a tmpfs cannot be mounted here")
    try:
        end = bake(reference.capture, disk / "out")
        assert end.code == 75 and "is full" in end.text and "Traceback" not in end.text, end
        subprocess.run(["mount", "-o", f"remount,size={20 * need}", str(disk)], check=True)
        assert reference.check(disk / "out", f"disk full at {share:.0%}") == "recovered"
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=False)


@pytest.fixture(scope="session")
def failing_writes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library that makes writes below one folder fail."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or sys.platform != "linux":
        pytest.skip("needs Linux and a C compiler")
    target = tmp_path_factory.mktemp("preload") / "failing_writes.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", str(target), str(PRELOAD), "-ldl"], check=True)
    return target


def failed_writes(reference: Reference, folder: Path, library: Path, count: int, seed: int) -> Counter[str]:
    rng, outcomes = random.Random(seed), Counter[str]()
    for turn in range(count):
        stage, error = rng.choice(STAGES), rng.choice(["EIO", "ENOSPC"])
        out = reference.unfinished(folder / str(turn), stage)
        after = int(10 ** rng.uniform(0, 2.3))
        extra = {"LD_PRELOAD": str(library), "FAIL_FOLDER": str(out), "FAIL_AFTER": str(after), "FAIL_WITH": error}
        what = f"{error} from call {after} on after {stage} (turn {turn}, seed {seed})"
        end = bake(reference.capture, out, extra)
        assert end.code == 0 or end.refused, f"{what}: exit {end.code}\n{end.text[-3000:]}"
        outcome = reference.check(out, what)
        assert outcome == "recovered", what
        outcomes["unnoticed" if end.code == 0 else outcome] += 1
        shutil.rmtree(out)
    return outcomes


@pytest.mark.slow
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("seed", range(5))
def test_many_failing_writes(
    reference: Reference, tmp_path: Path, failing_writes: Path, capsys: pytest.CaptureFixture[str], seed: int
) -> None:
    tell(capsys, "failing writes", failed_writes(reference, tmp_path, failing_writes, 10, 300 + seed))
