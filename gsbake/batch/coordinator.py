"""`gsbake batch`: plans all captures, lets Snakemake run the jobs that are left, and says how each capture ended.

gsbake schedules nothing itself. Each call plans anew from the stores, so a batch whose coordinator died goes on with what is left, and a
finished one starts nothing. Snakemake's own records are thrown away after each call. Several captures on one machine share its cores and
its memory: the threads of the running jobs add up to at most the cores, their memory to at most what is free.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import psutil
from filelock import FileLock, Timeout

from gsbake import api
from gsbake.atomic import write_atomic
from gsbake.batch.captures import BatchOptions, CapturePlan, plan_captures
from gsbake.batch.estimate import History
from gsbake.batch.jobs import Job, make_jobs
from gsbake.batch.records import FOLDER, Record, all_records, earlier_failures, forget_records, save_batch
from gsbake.errors import InterruptedRun, UsageError
from gsbake.pipeline.files import ensure_output_folder
from gsbake.pipeline.machine import default_threads
from gsbake.pipeline.supervise import StopSignals
from gsbake.python_process import python_command, python_environment

EXECUTORS = ("local", "slurm")
#: Times that Snakemake starts a job again which was interrupted or killed.
RETRIES = 3
#: Share of the free memory that jobs may reserve.
_MEMORY_SHARE = 0.9
#: Seconds between looks at the records, and seconds for jobs to write their checkpoints after a stop request.
_POLL, _STOP_TIMEOUT = 0.2, 45.0


@dataclass(frozen=True)
class Outcome:
    """End of a capture in a batch: `state` is done, cached, failed (will not help to retry) or unfinished (the same command goes on)."""

    plan: CapturePlan
    state: str
    message: str = ""
    exit_code: int = 0


def run_batch(
    captures: Sequence[Path],
    options: BatchOptions,
    executor: str = "local",
    *,
    retry_failed: bool = False,
    workers: int = 100,
    on_record: Callable[[Record], None] = lambda record: None,
) -> list[Outcome]:
    """Bring all captures up to date; returns how each one ended, in order.

    `workers` is the number of jobs in Slurm's queue at a time; `on_record` is called at the end of each job. Raises UsageError when an
    executor is unknown or not installed, InterruptedRun when another batch works in the same folder, or on a stop request.
    """
    if executor not in EXECUTORS:
        raise UsageError(f"--executor is {' or '.join(EXECUTORS)}, not '{executor}'.")
    if options.threads == 0 and executor == "slurm":
        options = replace(options, threads=4)
    options = options.absolute()
    root = options.root
    ensure_output_folder(root)
    (root / FOLDER).mkdir(exist_ok=True)
    lock = FileLock(root / FOLDER / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InterruptedRun(f"Another batch works in '{root}'; wait for it, or look with `gsbake batch status --out {root}`.") from None
    with lock:
        _end_orphan(root)
        plans = plan_captures(captures, options)
        save_batch(captures, options)
        failures = {} if retry_failed else earlier_failures(root, plans)
        forget_records(root, list(failures.values()))
        pending = [plan for plan in plans if not plan.done and not plan.error and plan.name not in failures]
        if pending:
            cores = options.threads or default_threads()
            threads = max(1, cores // len(pending)) if executor == "local" else cores
            outs = sorted(path.parent for path in root.glob("*/project.json"))
            jobs = make_jobs(
                [plan if plan in pending else replace(plan, error="left out") for plan in plans],
                options, History.of_runs(outs, api.REGISTRY.names), threads,
            )  # fmt: skip
            with StopSignals() as stop:
                _run_snakemake(jobs, options, executor, cores, workers, stop, on_record)
            plans = plan_captures(captures, options)
        return _outcomes(plans, failures, {plan.name for plan in pending}, root)


def outcomes_now(captures: Sequence[Path], options: BatchOptions) -> list[Outcome]:
    """How far each capture of a batch is, from the stores and the records; nothing is run."""
    plans = plan_captures(captures, options)
    return _outcomes(plans, earlier_failures(options.root, plans), set(), options.root)


def _outcomes(plans: Sequence[CapturePlan], failures: dict[str, Record], ran: set[str], root: Path) -> list[Outcome]:
    last = {record.capture: record for record in all_records(root)}
    found = []
    for plan in plans:
        record = last.get(plan.name)
        if plan.error:
            found.append(Outcome(plan, "failed", plan.error, plan.exit_code))
        elif plan.done:
            found.append(Outcome(plan, "done" if plan.name in ran else "cached"))
        elif plan.name in failures:
            found.append(Outcome(plan, "failed", failures[plan.name].message, failures[plan.name].exit_code))
        elif record is not None and record.final and plan.name in ran:
            found.append(Outcome(plan, "failed", record.message, record.exit_code))
        else:
            found.append(Outcome(plan, "unfinished", record.message if record is not None else "", InterruptedRun.exit_code))
    return found


def _run_snakemake(
    jobs: Sequence[Job],
    options: BatchOptions,
    executor: str,
    cores: int,
    workers: int,
    stop: StopSignals,
    on_record: Callable[[Record], None],
) -> None:
    """Run the jobs; failures of jobs are in their records. Raises UsageError without Snakemake, InterruptedRun on a stop request."""
    _require_snakemake(executor)
    work = options.root / FOLDER / "snakemake"
    shutil.rmtree(work, ignore_errors=True)  # markers of an earlier call would hide what is missing now
    work.mkdir(parents=True)
    memory = max(512, int(_MEMORY_SHARE * psutil.virtual_memory().available / 1e6))
    path = work / "jobs.json"
    local = executor == "local"
    rows = [
        {
            **job.document(),
            "memory_mb": min(job.memory_mb, memory) if local else job.memory_mb,
            "shell": shlex.join(python_command("-m", "gsbake.batch.job", str(path), job.id)),
        }
        for job in jobs
    ]
    document = {
        "root": str(options.root), "profile": options.profile, "overrides": list(options.overrides), "seed": options.seed,
        "store": options.store, "stages": api.REGISTRY.references, "retries": RETRIES, "grow_memory": not local, "jobs": rows,
    }  # fmt: skip
    write_atomic(path, json.dumps(document))
    arguments = [
        "--snakefile", str(Path(__file__).with_name("workflow.smk")), "--directory", str(work), "--config", f"jobs={path}",
        "--executor", executor, "--keep-going", "--nolock", "--scheduler", "greedy", "--rerun-triggers", "mtime",
    ]  # fmt: skip
    arguments += ["--cores", str(cores), "--resources", f"mem_mb={memory}"] if local else ["--jobs", str(workers), "--latency-wait", "60"]
    with (options.root / FOLDER / "snakemake.log").open("wb") as log:
        process = subprocess.Popen(
            python_command("-m", "snakemake", *arguments),
            cwd=work, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=python_environment(), start_new_session=True,
        )  # fmt: skip
        _orphan_file(options.root).write_text(json.dumps({"pid": process.pid, "started": psutil.Process(process.pid).create_time()}))
        seen: set[str] = set()
        try:
            while process.poll() is None:
                stop.check()
                _report(options.root, seen, on_record)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL)
        finally:
            _end(process)
    _report(options.root, seen, on_record)
    if not seen and process.returncode:
        raise UsageError(
            f"Snakemake could not start the jobs (exit code {process.returncode}); see '{options.root / FOLDER / 'snakemake.log'}'."
        )


def _require_snakemake(executor: str) -> None:
    missing = [
        name
        for name, module in (("snakemake", "snakemake"), ("snakemake-executor-plugin-slurm", "snakemake_executor_plugin_slurm"))
        if (name == "snakemake" or executor == "slurm") and importlib.util.find_spec(module) is None
    ]
    if missing:
        raise UsageError(f"`gsbake batch` needs {' and '.join(missing)}: pip install 'gsbake[batch]'.")
    if executor == "slurm" and shutil.which("sbatch") is None:
        raise UsageError(
            "--executor slurm needs Slurm's command sbatch on the PATH; install Slurm's client tools, or use --executor local."
        )


def _report(root: Path, seen: set[str], on_record: Callable[[Record], None]) -> None:
    for record in all_records(root):
        stamp = f"{record.job} {record.finished}"
        if stamp not in seen:
            seen.add(stamp)
            on_record(record)


def _orphan_file(root: Path) -> Path:
    return root / FOLDER / "snakemake.json"


def _end_orphan(root: Path) -> None:
    """Stop the Snakemake of a coordinator that was killed, with its local jobs; they write checkpoints."""
    with suppress(OSError, ValueError, KeyError, TypeError, psutil.Error):
        body = json.loads(_orphan_file(root).read_text())
        process = psutil.Process(int(body["pid"]))
        if abs(process.create_time() - float(body["started"])) < 0.01 and os.getpgid(process.pid) == process.pid:
            os.killpg(process.pid, signal.SIGTERM)
            with suppress(psutil.TimeoutExpired):
                process.wait(_STOP_TIMEOUT)
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    _orphan_file(root).unlink(missing_ok=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask Snakemake and its local jobs to stop, which write checkpoints; kill them after a time. Snakemake cancels Slurm's jobs."""
    for number, timeout in ((signal.SIGTERM, _STOP_TIMEOUT), (signal.SIGKILL, 5.0)):
        if process.poll() is not None:
            return
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout)
