"""Throughput of `gsbake batch` on one machine beside a plain loop: overhead, and two workers of one thread against one.

python -m benchmarks.batch [--captures 4] [--rounds 3] [--profile smoke] [--views 12] [--size 96] [--out DIR] [--csv FILE]

Bakes built-in captures of different seeds in three ways, in turns, each into an empty folder: `loop` (one `gsbake run --threads 1` after
another), `one` (`gsbake batch --threads 1`: one job of one thread at a time) and `two` (`gsbake batch --threads 2`: two jobs of one thread
side by side). A row has wall seconds, CPU seconds of all processes, the seconds of the jobs as their records say, and the machine's load
before. Where other programs run, wall seconds say little; these figures do not need an idle machine:

- overhead: CPU seconds of `one` over those of `loop`, and the share of `one`'s time in which no job ran;
- two workers: 2 × CPU of `one` / CPU of `two` × share of time in which `two`'s workers had jobs / the same of `one`: how much more is
  finished in a second when each worker has a core.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import ctypes
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from statistics import median

from benchmarks.csv_rows import today
from benchmarks.timeline import ROOT
from gsbake.batch.records import all_records
from gsbake.python_process import python_command, python_environment
from gsbake.synth.capture import write_capture

RESULTS = ROOT / "benchmarks" / "results" / "batch.csv"
WAYS = ("loop", "one", "two")
WORKERS = {"loop": 1, "one": 1, "two": 2}

#: Option of prctl(2).
PR_SET_CHILD_SUBREAPER = 36


@dataclass(frozen=True)
class Row:
    """One way in one round: seconds of wall time, of CPU, and of the jobs; `busy` is the share of its workers' time that jobs took."""

    round: int
    way: str
    captures: int
    wall: float
    cpu: float
    jobs: float
    busy: float
    load: float
    date: str = field(default_factory=today)


@dataclass(frozen=True)
class Ratios:
    """Of one round: `overhead` in CPU, `gaps` is the share of a batch with one worker in which no job ran, `workers` the gain of a
    second."""

    overhead: float
    gaps: float
    workers: float
    wall_overhead: float
    wall_workers: float


def adopt_orphans() -> None:
    """Make this process the parent of descendants whose own parent ends first, so that `timed` can count what they used (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def timed(command: Sequence[str]) -> tuple[float, float]:
    """Wall seconds of a command, and CPU seconds of it with all that it started. Raises RuntimeError when it fails.

    Processes that outlive the command are waited for: those whose parent does not wait for them would not be counted.
    """
    adopt_orphans()
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    code = subprocess.run(command, env=python_environment({"OMP_WAIT_POLICY": "PASSIVE"}), stdout=subprocess.DEVNULL).returncode
    wall = time.perf_counter() - start
    if code:
        raise RuntimeError(f"exit code {code}: {' '.join(command)}")
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(way: str, number: int, captures: Sequence[Path], profile: str, out: Path) -> Row:
    """Bake all captures in one way."""
    shutil.rmtree(out, ignore_errors=True)
    load = os.getloadavg()[0]
    common = ("--profile", profile, "--quiet")
    if way == "loop":
        runs = [
            timed(python_command("-m", "gsbake", "run", str(path), "--out", str(out / path.name), "--threads", "1", *common))
            for path in captures
        ]
        wall, cpu = sum(run[0] for run in runs), sum(run[1] for run in runs)
        return Row(number, way, len(captures), wall, cpu, wall, 1.0, load)
    names = [str(path) for path in captures]
    wall, cpu = timed(python_command("-m", "gsbake", "batch", *names, "--out", str(out), "--threads", str(WORKERS[way]), *common))
    jobs = sum(record.seconds for record in all_records(out))
    return Row(number, way, len(captures), wall, cpu, jobs, jobs / (WORKERS[way] * wall), load)


def ratios(rows: Sequence[Row]) -> list[Ratios]:
    """The ratios of each round."""
    found = []
    for number in sorted({row.round for row in rows}):
        by = {row.way: row for row in rows if row.round == number}
        loop, one, two = (by[way] for way in WAYS)
        found.append(
            Ratios(
                one.cpu / loop.cpu - 1,
                1 - one.busy,
                2 * one.cpu / two.cpu * two.busy / one.busy,
                one.wall / loop.wall - 1,
                one.wall / two.wall,
            )
        )
    return found


def summary(found: Sequence[Ratios]) -> str:
    """Medians over the rounds, with their range."""

    def line(name: str, text: str, form: str) -> str:
        values = sorted(getattr(ratio, name) for ratio in found)
        return f"{text}: {form.format(median(values))} ({form.format(values[0])} to {form.format(values[-1])})\n"

    return (
        line("overhead", "overhead of a batch over a loop, CPU", "{:+.1%}")
        + line("gaps", "time of a batch with one worker in which no job ran", "{:.1%}")
        + line("workers", "two workers of one thread against one, from CPU and gaps", "{:.2f}")
        + line("wall_overhead", "the first by wall time", "{:+.1%}")
        + line("wall_workers", "the third by wall time", "{:.2f}")
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure in turns, print the ratios, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--profile", default="smoke")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "batch")
    parser.add_argument("--csv", type=Path, default=RESULTS)
    args = parser.parse_args(arguments)
    captures = [args.out / "captures" / f"object{seed}" for seed in range(args.captures)]
    for seed, path in enumerate(captures):
        if not (path / "images").is_dir():
            write_capture(path, args.views, args.size, seed=seed)
    rows = []
    for number in range(args.rounds):
        for way in WAYS[number % 3 :] + WAYS[: number % 3]:
            rows.append(measure(way, number, captures, args.profile, args.out / "baked"))
            sys.stdout.write(f"{rows[-1]}\n")
            sys.stdout.flush()
    sys.stdout.write(summary(ratios(rows)))
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    with args.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Row)], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: round(v, 3) if isinstance(v, float) else v for k, v in asdict(row).items()})


if __name__ == "__main__":
    main()
