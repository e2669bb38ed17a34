"""`gsbake plan`, `gsbake batch` and `gsbake batch status`."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from gsbake import api
from gsbake.batch.captures import BatchOptions, plan_captures
from gsbake.batch.coordinator import Outcome, outcomes_now, run_batch
from gsbake.batch.emit import FORMATS, emit
from gsbake.batch.jobs import Job, make_jobs
from gsbake.batch.page import INDEX, write_index
from gsbake.batch.records import Record, load_batch
from gsbake.batch.slurm import SlurmOptions
from gsbake.cli.output import cell, print_json, print_table, print_text
from gsbake.errors import BadInputError, InterruptedRun, UsageError
from gsbake.pipeline.machine import default_threads
from gsbake.pipeline.shared_store import refuse_other_folders
from gsbake.pipeline.store_url import VARIABLE
from gsbake.text import duration, size
from gsbake.timing.estimate import History

_STYLES = {"done": "green", "cached": "green", "failed": "red", "unfinished": "yellow", "running": "cyan"}


def plan(captures: Sequence[Path], options: BatchOptions, form: str | None) -> None:
    """Print the jobs of captures as a table, or in a scheduler's format. Raises BadInputError after the rest when a capture is unusable."""
    if form is not None and form not in FORMATS:
        raise UsageError(f"--emit is one of {', '.join(FORMATS)}, not '{form}'.")
    options = options.absolute()
    refuse_other_folders(options.store)
    plans = plan_captures(captures, options)
    outs = sorted(path.parent for path in options.root.glob("*/project.json"))
    jobs = make_jobs(plans, options, History.of_runs(outs, api.REGISTRY.names), options.threads or default_threads())
    if form is not None:
        typer.echo(os.fsencode(emit(form, jobs)), nl=False)  # names that are no text keep their bytes
        if jobs and options.store is not None and options.named_store is None:
            print_text(f"The store's address has credentials and is not in the jobs; set {VARIABLE} where they run.", error=True)
    else:
        _print_jobs(jobs, sum(plan.done for plan in plans))
    failed = [plan for plan in plans if plan.error]
    if failed:
        raise BadInputError(f"{len(failed)} of {len(plans)} captures cannot be baked; {failed[0].name}: {failed[0].error}")


def _print_jobs(jobs: Sequence[Job], done: int) -> None:
    rows = [
        (job.capture, ", ".join(job.stages), str(job.threads), size(1e6 * job.memory_mb), duration(job.seconds), ", ".join(job.needs))
        for job in jobs
    ]
    if rows:
        print_table(("capture", "stages", "threads", "memory", "time", "after"), rows)
    print_text(f"{len(jobs)} jobs, about {duration(sum(job.seconds for job in jobs))} one after another; {done} captures are done.")


def batch(
    captures: Sequence[Path],
    options: BatchOptions,
    executor: str,
    *,
    retry_failed: bool,
    workers: int,
    slurm: SlurmOptions,
    quiet: bool,
    as_json: bool,
) -> None:
    """Bake the captures, write the index, and print how each ended.

    Raises BadInputError when captures failed, InterruptedRun when some are unfinished.
    """
    start = time.perf_counter()

    def on_record(record: Record) -> None:
        if not quiet and not as_json:
            print_text(f"{record.capture}: {record.message or f'{record.job} done in {duration(record.seconds)}'}")

    outcomes = run_batch(captures, options, executor, retry_failed=retry_failed, workers=workers, slurm=slurm, on_record=on_record)
    index = _write_index(outcomes, options.root)
    if as_json:
        print_json({**_document(outcomes), "index": str(index), "seconds": round(time.perf_counter() - start, 3)})
    elif not quiet:
        done = sum(outcome.state in ("done", "cached") for outcome in outcomes)
        cached = sum(outcome.state == "cached" for outcome in outcomes)
        print_text(f"{done} of {len(outcomes)} captures done, {cached} of them cached, in {duration(time.perf_counter() - start)}: {index}")
    _raise_failures(outcomes)


def status(root: Path, as_json: bool) -> None:
    """Print how far each capture of the batch in `root` is, and write the index."""
    captures, options = load_batch(root)
    outcomes = outcomes_now(captures, options)
    _write_index(outcomes, root)
    if as_json:
        print_json(_document(outcomes))
        return
    rows = [
        (o.plan.name, cell(o.state, _STYLES[o.state]), f"{len(o.plan.states) - len(o.plan.to_run)} of {len(o.plan.states)}", o.message)
        for o in outcomes
    ]
    print_table(("capture", "state", "stages", "message"), rows)


def _write_index(outcomes: Sequence[Outcome], root: Path) -> Path:
    """Write the index; where another page has its name, say so and where the index is."""
    path = write_index(outcomes, root.absolute())
    if path.name != INDEX:
        print_text(
            f"gsbake: warning: '{path.with_name(INDEX)}' is not as gsbake wrote it and stays; the index is '{path}'. "
            "Move yours away to have it there.",
            error=True,
        )
    return path


def _document(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    return {
        "captures": [
            {
                "name": o.plan.name,
                "out": str(o.plan.out),
                "state": o.state,
                "exit_code": o.exit_code,
                "message": o.message,
                "stages_done": len(o.plan.states) - len(o.plan.to_run),
                "stages": len(o.plan.states),
            }
            for o in outcomes
        ]
    }


def _raise_failures(outcomes: Sequence[Outcome]) -> None:
    failed = [o for o in outcomes if o.state == "failed"]
    unfinished = [o for o in outcomes if o.state == "unfinished"]
    if unfinished:
        reason = f" ({unfinished[0].plan.name}: {unfinished[0].message})" if unfinished[0].message else ""
        raise InterruptedRun(f"{len(unfinished)} of {len(outcomes)} captures are unfinished{reason}; the same command goes on.")
    if failed:
        text = f"{len(failed)} of {len(outcomes)} captures failed; {failed[0].plan.name}: {failed[0].message}"
        raise BadInputError(text)
