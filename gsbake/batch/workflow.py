"""Runs the jobs of a batch with Snakemake, and ends it when nothing is left to wait for.

Snakemake's own records are thrown away before each run: what is done is what gsbake's stores say. Snakemake may lose sight of jobs in
Slurm's queue: when slurmctld does not answer for a while, its plugin forgets them and waits for ever. So this module watches the queue
too, and ends a Snakemake that waits although no job of the batch is left. The caller then plans anew.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from gsbake import api
from gsbake.atomic import write_atomic
from gsbake.batch import slurm
from gsbake.batch.captures import BatchOptions
from gsbake.batch.jobs import LEVELS, Job, start_levels
from gsbake.batch.records import FOLDER, Record, RecordReader
from gsbake.errors import UsageError
from gsbake.pipeline.store_url import VARIABLE
from gsbake.pipeline.supervise import StopSignals
from gsbake.python_process import python_command, python_environment
from gsbake.system.processes import leads_group, shell_line, start_apart, stop_group

EXECUTORS = ("local", "slurm")
#: The document of the jobs, in the folder that Snakemake and its jobs run in; workflow.smk reads it.
DOCUMENT = "jobs.json"
#: Times that a job is started again which was interrupted or killed.
RETRIES = 3
#: Share of the free memory that jobs on this machine may reserve.
_MEMORY_SHARE = 0.9
#: Seconds between looks at the records, on this machine and with Slurm, and at Slurm's queue.
_POLL, _SLURM_POLL, _QUEUE_POLL = 0.2, 1.0, 5.0
#: Seconds for jobs on this machine to write their checkpoints after a stop request, and for a Snakemake without jobs to end.
_STOP_TIMEOUT, _IDLE_TIMEOUT = 45.0, 5.0
#: Seconds without a job in Slurm's queue after which a waiting Snakemake has lost sight of something.
STALL_TIMEOUT = 60.0


@dataclass(frozen=True)
class Execution:
    """Where the jobs run: `cores` that they may fill together and, with Slurm, its cluster, the user's choices, and most jobs in the
    queue."""

    cores: int
    cluster: slurm.Cluster | None = None
    slurm: slurm.SlurmOptions = slurm.SlurmOptions()
    workers: int = 0

    @property
    def executor(self) -> str:
        """Snakemake's name of the executor."""
        return "local" if self.cluster is None else "slurm"


def require_snakemake(executor: str) -> None:
    """Raises UsageError for an unknown executor, and when a package that it needs is not installed."""
    if executor not in EXECUTORS:
        raise UsageError(f"--executor is {' or '.join(EXECUTORS)}, not '{executor}'.")
    missing = [
        name
        for name, module in (("snakemake", "snakemake"), ("snakemake-executor-plugin-slurm", "snakemake_executor_plugin_slurm"))
        if (name == "snakemake" or executor == "slurm") and importlib.util.find_spec(module) is None
    ]
    if missing:
        raise UsageError(f"`gsbake batch` needs {' and '.join(missing)}: pip install 'gsbake[batch]'.")


def run_workflow(
    jobs: Sequence[Job],
    options: BatchOptions,
    execution: Execution,
    reader: RecordReader,
    stop: StopSignals,
    on_record: Callable[[Record], None],
) -> bool:
    """Run the jobs; how they ended is in their records. Returns False when Snakemake stalled and the caller should plan again.

    Raises UsageError when Snakemake cannot start, InterruptedRun on a stop request.
    """
    work = options.root / FOLDER / "snakemake"
    shutil.rmtree(work, ignore_errors=True)  # markers of an earlier call would hide what is missing now
    work.mkdir(parents=True)
    prefix = slurm.job_prefix(options.root)
    arguments = _prepare(jobs, options, execution, work, prefix)
    progress = _Progress(jobs)
    queue = None if execution.cluster is None else _Queue(prefix)
    with (options.root / FOLDER / "snakemake.log").open("wb") as log:
        process = start_apart(
            python_command("-m", "snakemake", *arguments),
            cwd=work, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=job_environment(options),
        )  # fmt: skip
        started = psutil.Process(process.pid).create_time()
        _process_file(options.root).write_bytes(
            json.dumps({"pid": process.pid, "started": started, "executor": execution.executor}).encode()
        )
        stalled = False
        try:
            while process.poll() is None and not stalled:
                stop.check()
                progress.take(reader.new_records(), on_record)
                if queue is not None:
                    stalled = queue.abandoned(progress.settled)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL if queue is None else _SLURM_POLL)
        finally:
            if process.poll() is None:  # its jobs on this machine write checkpoints
                stop_group(process.pid, _IDLE_TIMEOUT if stalled or queue is not None else _STOP_TIMEOUT)
                process.wait()
            if queue is not None:
                slurm.cancel_jobs(prefix)
    progress.take(reader.new_records(), on_record)
    if not progress.records and process.returncode and not stalled:
        raise UsageError(
            f"Snakemake could not start the jobs (exit code {process.returncode}); see '{options.root / FOLDER / 'snakemake.log'}'."
        )
    return progress.settled or not stalled


def job_environment(options: BatchOptions) -> dict[str, str]:
    """Environment of Snakemake, which its jobs inherit, with Slurm too: the store's address with its credentials is in no file."""
    return python_environment({VARIABLE: options.store} if options.store is not None and options.named_store is None else None)


def end_orphan(root: Path) -> None:
    """Stop the Snakemake of a coordinator that was killed, and its jobs, on this machine or in Slurm's queue; they write checkpoints."""
    body: dict[str, Any] = {}
    with suppress(OSError, ValueError, KeyError, TypeError, psutil.Error):
        body = json.loads(_process_file(root).read_bytes())
        process = psutil.Process(int(body["pid"]))
        if abs(process.create_time() - float(body["started"])) < 0.01 and leads_group(process.pid):
            stop_group(process.pid, _STOP_TIMEOUT)
    if body.get("executor") == "slurm":
        slurm.cancel_jobs(slurm.job_prefix(root))
    _process_file(root).unlink(missing_ok=True)


class _Progress:
    """Which jobs are still to be waited for: neither done, nor of a capture that failed for good."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._left = {job.id: job.capture for job in jobs}
        self.records = 0

    @property
    def settled(self) -> bool:
        """Whether no job is left."""
        return not self._left

    def take(self, records: Sequence[Record], on_record: Callable[[Record], None]) -> None:
        """Count new records and pass them on."""
        for record in records:
            self.records += 1
            if record.exit_code == 0:
                self._left.pop(record.job, None)
            elif record.final:
                self._left = {name: capture for name, capture in self._left.items() if capture != record.capture}
            on_record(record)


class _Queue:
    """Whether Slurm's queue holds jobs of the batch."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._asked = time.monotonic()
        self._filled: float | None = None  # when it last held a job; None before the first one
        self._empty = False

    def abandoned(self, settled: bool) -> bool:
        """Whether no job is left: at once when all are `settled`; else when the queue has been empty for too long after it held one."""
        now = time.monotonic()
        if now - self._asked >= _QUEUE_POLL:
            self._asked = now
            jobs = slurm.queued_jobs(self._prefix)
            self._empty = jobs == []
            if jobs or (jobs is None and self._filled is not None):
                self._filled = now
        return self._empty and (settled or (self._filled is not None and now - self._filled > STALL_TIMEOUT))


def _prepare(jobs: Sequence[Job], options: BatchOptions, execution: Execution, work: Path, prefix: str) -> list[str]:
    """Write the document of the jobs into `work`, in which Snakemake runs; returns its arguments.

    No path is among them: Snakemake reads values of `--config` as YAML, and its plugin writes arguments between double quotes.
    """
    memory, nodes, chosen = max(512, int(_MEMORY_SHARE * psutil.virtual_memory().available / 1e6)), 1, {}
    extra = ["--cores", str(execution.cores), "--resources", f"mem_mb={memory}"]
    cluster = execution.cluster
    if cluster is not None:
        memory, nodes = cluster.largest_mb, cluster.nodes
        choice = {"slurm_partition": execution.slurm.partition, "slurm_account": execution.slurm.account}
        chosen = {name: value for name, value in choice.items() if value is not None}
        extra = ["--jobs", str(execution.workers), "--latency-wait", "60", *slurm.snakemake_arguments(cluster, prefix)]
    levels = start_levels(jobs)
    rows = [
        {
            "id": job.id, "photos": job.photos, "out": job.out, "capture": job.capture, "stages": job.stages, "needs": job.needs,
            "threads": job.threads, "memory_mb": min(job.memory_mb, memory), "minutes": job.minutes,
            "level": levels[job.id],
            "shell": shell_line(python_command("-m", "gsbake.batch.job", DOCUMENT, job.id)),
        }
        for job in jobs
    ]  # fmt: skip
    document = {
        "root": str(options.root), "profile": options.profile, "overrides": list(options.overrides), "seed": options.seed,
        "store": options.named_store, "moved": options.moved, "stages": api.REGISTRY.references, "grow": cluster is not None,
        "most_memory_mb": memory, "nodes": nodes, "records": str(options.root / FOLDER / "records"), "resources": chosen, "levels": LEVELS,
        "nice": 0 if cluster is None else cluster.nice, "jobs": rows,
    }  # fmt: skip
    write_atomic(work / DOCUMENT, json.dumps(document))
    return [
        "--snakefile", str(Path(__file__).with_name("workflow.smk")),
        "--executor", execution.executor, "--retries", str(RETRIES), "--keep-going", "--nolock", "--scheduler", "greedy",
        "--rerun-triggers", "mtime", *extra,
    ]  # fmt: skip


def _process_file(root: Path) -> Path:
    return root / FOLDER / "snakemake.json"
