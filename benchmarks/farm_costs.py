"""Costs that the simulation of a farm starts from: stages, the start of a job, and the coordinator's work per job and per capture.

python -m benchmarks.farm_costs CAPTURE… [--profile relight] [--out DIR] [--json FILE]

All seconds are CPU seconds of one thread (user and system), so that other programs on the machine change them little: what a stage would
take on a free core whose disk is not slow. CAPTURE is a folder of photos, or `built-in`. A stage's row has the CPU seconds of its
processes (from their start), the bytes of the artifacts and photos that it reads, the bytes that it writes, and its peak memory. The start
of a job is two starts of Snakemake, which its Slurm executor needs, and a `gsbake.batch.job` that finds everything cached. The
coordinator's costs are those of Snakemake with jobs that do nothing, and of planning captures that were never baked.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

from benchmarks.farm_model import StageCost
from benchmarks.skip import CpuClock
from benchmarks.timeline import BUILT_IN, ROOT
from gsbake.api import RunOptions, open_session
from gsbake.batch import workflow
from gsbake.batch.captures import BatchOptions, plan_captures
from gsbake.batch.jobs import LEVELS
from gsbake.capture.sources import PHOTO_FOLDERS
from gsbake.pipeline.store import Artifact
from gsbake.python_process import python_command, python_environment
from gsbake.stages import REGISTRY
from gsbake.synth.capture import write_capture

RESULTS = ROOT / "benchmarks" / "results" / "farm-costs.json"
#: Snakemake starts of a Slurm job: in the batch script, and inside its step.
_SNAKEMAKES = 2
#: Jobs of the two runs of Snakemake whose difference gives its time per job, and captures that are planned.
_FEW, _MANY, _PLANNED = 50, 450, 40


@dataclass(frozen=True)
class Kind:
    """A measured capture: photos, their bytes, and its stages; `peak_mb` of each."""

    capture: str
    profile: str
    photos: int
    photo_bytes: int
    stages: tuple[StageCost, ...]
    peak_mb: tuple[float, ...]


@dataclass(frozen=True)
class Costs:
    """Everything measured; seconds of CPU."""

    kinds: tuple[Kind, ...]
    job_start: float
    submit: float
    plan: float


def measure_kind(folder: Path, profile: str, out: Path) -> Kind:
    """Bake a capture with one thread; finished stages are taken from an earlier measurement in `out`."""
    clock = CpuClock(out / "cpu.json")
    session = open_session(RunOptions(folder, out, profile, threads=1), clock)
    states = session.engine.run()
    session.project.save(out)
    sizes: dict[str, float] = {}
    for state in states:
        assert state.artifact is not None
        sizes[state.name] = _size(state.artifact)
    sources = session.engine.request.sources
    names = session.engine.request.source_names
    source_bytes = {
        name: float(sum((path / n).stat().st_size for n in names.get(name, ())) if path.is_dir() else path.stat().st_size)
        for name, path in sources.items()
    }
    stages = tuple(
        StageCost(
            state.name, round(clock.total([state]), 2), bytes_read(state.name, sizes, source_bytes), sizes[state.name]
        )
        for state in states
    )  # fmt: skip
    peaks = tuple(round(state.artifact.manifest["peak_bytes"] / 1e6, 1) for state in states if state.artifact is not None)
    name = folder.parent.name if folder.name in PHOTO_FOLDERS else folder.name
    return Kind(name, profile, len(names.get("photos", ())), int(source_bytes["photos"]), stages, peaks)


def bytes_read(stage: str, artifacts: Mapping[str, float], sources: Mapping[str, float]) -> float:
    """Bytes that a stage reads: the artifacts of the stages that it needs, and its sources."""
    declared = REGISTRY.load(stage)
    return sum(artifacts[need] for need in declared.needs) + sum(sources.get(name, 0.0) for name in declared.sources)


def _size(artifact: Artifact) -> float:
    return float(sum(int(entry["bytes"]) for entry in artifact.manifest["files"].values()))


def snakemake_cpu(count: int, folder: Path) -> float:
    """CPU seconds of Snakemake itself, without those of the jobs, for `count` jobs that do nothing, in chains of three."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    jobs = [
        {
            "id": f"j{n}",
            "needs": [f"j{n - 1}"] if n % 3 else [],
            "threads": 1,
            "memory_mb": 1,
            "minutes": 1,
            "shell": ":",
            "level": n % LEVELS,
        }
        for n in range(count)
    ]
    body = {
        "jobs": jobs,
        "grow": False,
        "most_memory_mb": 1000,
        "nodes": 1,
        "records": str(folder),
        "resources": {},
        "levels": LEVELS,
        "nice": 1,
    }
    (folder / "jobs.json").write_text(json.dumps(body))
    command = python_command(
        "-m", "snakemake", "--snakefile", str(Path(workflow.__file__).with_name("workflow.smk")), "--directory", str(folder),
        "--config", f"jobs={folder / 'jobs.json'}", "--executor", "local", "--cores", "8", "--nolock", "--scheduler", "greedy",
        "--rerun-triggers", "mtime", "--quiet", "all",
    )  # fmt: skip
    used = 0.0
    with subprocess.Popen(command, env=python_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            try:
                times = watched.cpu_times()
            except psutil.Error:
                break
            used = times.user + times.system
            time.sleep(0.05)
    if process.returncode:
        raise RuntimeError(f"Snakemake ended with {process.returncode}")
    return used


def job_cpu(out: Path, folder: Path, profile: str, scratch: Path) -> float:
    """CPU seconds of `gsbake.batch.job` on a finished capture, and of a start of Snakemake with one job, as often as a Slurm job has
    them."""
    path = scratch / "jobs.json"
    job = {"id": "j", "capture": "c", "photos": str(folder), "out": str(out), "stages": ["report"], "threads": 1}
    options = {"root": str(scratch), "profile": profile, "overrides": [], "seed": 0, "store": None}
    body = {**options, "stages": REGISTRY.references, "jobs": [job]}
    path.write_text(json.dumps(body))
    process = subprocess.Popen(python_command("-m", "gsbake.batch.job", str(path), "j"), env=python_environment())
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"gsbake.batch.job ended with {process.returncode}")
    return used.ru_utime + used.ru_stime + _SNAKEMAKES * snakemake_cpu(1, scratch / "one")


def plan_cpu(folder: Path, profile: str, scratch: Path) -> float:
    """CPU seconds of planning one capture that was never baked."""
    photos = next((folder / name for name in PHOTO_FOLDERS if (folder / name).is_dir()), folder)
    captures = []
    for number in range(_PLANNED):
        captures.append(scratch / f"copy{number}")
        shutil.copytree(photos, captures[-1] / "images", dirs_exist_ok=True)
    start = time.process_time()
    plan_captures(captures, BatchOptions(scratch / "never", profile))
    used = time.process_time() - start
    for path in captures:
        shutil.rmtree(path)
    return used / _PLANNED


def read_costs(path: Path = RESULTS) -> Costs:
    """The costs in a file that `main` wrote."""
    body = json.loads(path.read_text())
    kinds = tuple(
        Kind(**{**kind, "stages": tuple(StageCost(**stage) for stage in kind["stages"]), "peak_mb": tuple(kind["peak_mb"])})
        for kind in body["kinds"]
    )
    return Costs(kinds, body["job_start"], body["submit"], body["plan"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure everything and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE")
    parser.add_argument("--profile", default="relight")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "farm")
    parser.add_argument("--json", type=Path, default=RESULTS)
    args = parser.parse_args(arguments)
    kinds, folders = [], []
    for name in args.captures:
        folder = Path(name)
        if name == BUILT_IN:
            folder = args.out / "built-in"
            if not (folder / "images").is_dir():
                write_capture(folder)
        folders.append(folder)
        kinds.append(measure_kind(folder, args.profile, args.out / args.profile / folder.name))
        sys.stdout.write(f"{kinds[-1].capture}: {sum(s.seconds for s in kinds[-1].stages):.0f} CPU seconds\n")
    scratch = args.out / "scratch"
    scratch.mkdir(parents=True, exist_ok=True)
    start = job_cpu(args.out / args.profile / folders[0].name, folders[0], args.profile, scratch)
    few, many = snakemake_cpu(_FEW, scratch / "few"), snakemake_cpu(_MANY, scratch / "many")
    submit, plan = (many - few) / (_MANY - _FEW), plan_cpu(folders[0], args.profile, scratch)
    costs = Costs(tuple(kinds), round(start, 3), round(submit, 4), round(plan, 4))
    shutil.rmtree(scratch)
    args.json.parent.mkdir(parents=True, exist_ok=True)
    args.json.write_text(json.dumps(asdict(costs), indent=1) + "\n")
    sys.stdout.write(f"start of a job {costs.job_start:.2f} s, coordinator {costs.submit:.4f} s a job and {costs.plan:.4f} s a capture\n")


if __name__ == "__main__":
    main()
