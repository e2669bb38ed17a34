"""`gsbake batch`: plans all captures, lets Snakemake run the jobs that are left, and says how each capture ended.

gsbake schedules nothing itself. Each call plans anew from the stores, so a batch whose coordinator died goes on with what is left, and a
finished one starts nothing. Snakemake's own records are thrown away after each call. Several captures on one machine share its cores and
its memory: the threads of the running jobs add up to at most the cores, their memory to at most what is free.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from filelock import FileLock, Timeout

from gsbake import api
from gsbake.batch.captures import BatchOptions, CapturePlan, plan_captures
from gsbake.batch.jobs import make_jobs
from gsbake.batch.records import (
    FOLDER,
    Record,
    RecordReader,
    all_records,
    earlier_failures,
    forget_records,
    require_own_records,
    save_batch,
)
from gsbake.batch.slurm import SlurmOptions, ask_cluster
from gsbake.batch.workflow import Execution, end_orphan, require_snakemake, run_workflow
from gsbake.errors import InterruptedRun, UsageError
from gsbake.pipeline.files import ensure_output_folder
from gsbake.pipeline.lease import HEARTBEAT_TIMEOUT, LeaseHolder
from gsbake.pipeline.machine import default_threads
from gsbake.pipeline.shared_store import refuse_other_folders
from gsbake.pipeline.supervise import StopSignals
from gsbake.timing.estimate import History

#: Most threads of a job with Slurm where the user names none: more are used ever less.
_SLURM_THREADS = 4
#: Jobs in Slurm's queue, of those that it can run at once, and at least.
_QUEUE_FACTOR, _LEAST_QUEUE = 2, 100
#: Times that what is left is planned anew, after a Snakemake that stalled or jobs that were interrupted too often for it.
_ROUNDS = 10


@dataclass(frozen=True)
class Outcome:
    """End of a capture in a batch: `state` is done, cached, failed (will not help to retry), unfinished (the same command goes on), or
    running while the batch does."""

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
    workers: int = 0,
    slurm: SlurmOptions = SlurmOptions(),  # noqa: B008 (immutable)
    on_record: Callable[[Record], None] = lambda record: None,
) -> list[Outcome]:
    """Bring all captures up to date; returns how each one ended, in order.

    `workers` is the number of jobs in Slurm's queue at a time (0: two for each core); `on_record` is called at the end of each job.
    Raises UsageError when an executor is unknown or not installed, or a folder is not gsbake's own, InterruptedRun when
    another batch works in the same folder, or on a stop request.
    """
    require_snakemake(executor)
    if executor == "slurm":
        if "%" in str(options.root.absolute()):
            raise UsageError(
                f"'{options.root}' holds '%', which Slurm takes for a variable in the paths of its logs; choose another --out."
            )
        cluster = ask_cluster(slurm)
        execution = Execution(cluster.cores, cluster, slurm, workers or max(_LEAST_QUEUE, _QUEUE_FACTOR * cluster.cores))
    else:
        execution = Execution(options.threads or default_threads())
    options = options.absolute()
    root = options.root
    require_own_records(root)
    if not (root / FOLDER).exists():
        plan_captures(captures, options)  # refuses wrong folders before anything is written
    refuse_other_folders(options.store)
    ensure_output_folder(root)
    (root / FOLDER).mkdir(exist_ok=True)
    lock = FileLock(root / FOLDER / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InterruptedRun(f"Another batch works in '{root}'; wait for it, or look with `gsbake batch status --out {root}`.") from None
    with lock:
        end_orphan(root)
        plans = plan_captures(captures, options)
        save_batch(captures, options)
        failures = {} if retry_failed else earlier_failures(root, plans)
        forget_records(root, list(failures.values()))
        ran: set[str] = set()
        with StopSignals() as stop:
            reader = RecordReader(root)
            for _ in range(_ROUNDS):
                given_up = {**earlier_failures(root, plans), **failures} if ran else failures
                pending = [plan for plan in plans if not plan.done and not plan.error and plan.name not in given_up]
                if not pending:
                    break
                ran |= {plan.name for plan in pending}
                left = _stages_left(plans)
                noticed = _run_round(plans, pending, options, execution, reader, stop, on_record)
                plans = plan_captures(captures, options)
                if noticed and _stages_left(plans) == left:
                    break  # what is interrupted again and again without getting on is left to the next batch
        return _outcomes(plans, failures, ran, root)


def _run_round(
    plans: Sequence[CapturePlan],
    pending: Sequence[CapturePlan],
    options: BatchOptions,
    execution: Execution,
    reader: RecordReader,
    stop: StopSignals,
    on_record: Callable[[Record], None],
) -> bool:
    """Run the jobs of the pending captures; False when Snakemake stalled."""
    threads = max(1, execution.cores // len(pending))
    if execution.cluster is not None:
        threads = options.threads or min(threads, _SLURM_THREADS)
    outs = sorted(path.parent for path in options.root.glob("*/project.json"))
    chosen = {plan.name for plan in pending}
    jobs = make_jobs(
        [plan if plan.name in chosen else replace(plan, error="left out") for plan in plans],
        options, History.of_runs(outs, api.REGISTRY.names), threads,
    )  # fmt: skip
    return run_workflow(jobs, options, execution, reader, stop, on_record)


def _stages_left(plans: Sequence[CapturePlan]) -> int:
    return sum(len(plan.to_run) for plan in plans)


def outcomes_now(captures: Sequence[Path], options: BatchOptions) -> list[Outcome]:
    """How far each capture of a batch is, from the stores and the records; nothing is run."""
    plans = plan_captures(captures, options)
    found = _outcomes(plans, earlier_failures(options.root, plans), set(), options.root)
    return [_with_running_stage(outcome) if outcome.state == "unfinished" else outcome for outcome in found]


def _with_running_stage(outcome: Outcome) -> Outcome:
    """The outcome, or state running and the stage with its process where one computes."""
    for state in outcome.plan.to_run:
        for path in sorted(outcome.plan.out.glob(f"stages/{state.name}/*.lease")):
            holder = LeaseHolder.read(path)
            if holder is None or holder.alive() is False:
                continue
            with suppress(OSError):
                if holder.alive() or time.time() - path.stat().st_mtime < HEARTBEAT_TIMEOUT:
                    return replace(outcome, state="running", message=f"{state.title}: {holder}.")
    return outcome


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
            message = record.message if record is not None and record.exit_code else ""
            found.append(Outcome(plan, "unfinished", message, InterruptedRun.exit_code))
    return found
