"""Jobs of a batch: stages that have to run, packed so that small ones share a job, with dependencies and resources.

A job brings its last stage up to date, and with it all before that. It may be run again at any time: what is cached is taken from the
cache, and the lease of a stage keeps two jobs from computing it twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from gsbake.batch.captures import BatchOptions, CapturePlan, identifier
from gsbake.timing.estimate import History

#: Expected seconds below which a job takes the next stage too: starting a job costs some seconds.
PACK_SECONDS = 120.0
#: A job's time limit is this many times the expected time, and at least the minutes below.
_LIMIT_FACTOR, _LEAST_MINUTES = 3.0, 10
#: Classes of jobs by what is expected to be left of their captures; the longest start first.
LEVELS = 64


@dataclass(frozen=True)
class Job:
    """One job: the `stages` of a capture, the command, the jobs it `needs`, and resources; `minutes` is a limit, `seconds` expected."""

    id: str
    capture: str
    photos: str
    out: str
    stages: tuple[str, ...]
    command: tuple[str, ...]
    needs: tuple[str, ...]
    threads: int
    memory_mb: int
    seconds: float
    minutes: int

    def document(self) -> dict[str, Any]:
        """The job as JSON."""
        return asdict(self)


def make_jobs(
    plans: Sequence[CapturePlan], options: BatchOptions, history: History, threads: int, pack_seconds: float = PACK_SECONDS
) -> list[Job]:
    """The jobs of all captures that are neither done nor failed; a job's dependencies come before it."""
    jobs: list[Job] = []
    for index, plan in enumerate(plans):
        if plan.error or plan.done:
            continue
        states = plan.to_run or plan.states[-1:]  # nothing to compute: the last stage publishes the results
        estimates = {s.name: history.estimate(s.name, plan.photo_set, s.settings, threads) for s in states}
        earlier: tuple[str, ...] = ()
        for members in group_stages([estimates[state.name].seconds for state in states], pack_seconds):
            group = [states[k] for k in members]
            last = group[-1].name
            seconds = sum(estimates[state.name].seconds for state in group)
            job = Job(
                id=f"{identifier(index, plan.name)}_{last}",
                capture=plan.name,
                photos=str(plan.photos),
                out=str(plan.out),
                stages=tuple(state.name for state in group),
                command=stage_command(last, plan, options, threads),
                needs=earlier,
                threads=threads,
                memory_mb=max(estimates[state.name].memory_mb for state in group),
                seconds=round(seconds, 1),
                minutes=max(_LEAST_MINUTES, math.ceil(_LIMIT_FACTOR * seconds / 60)),
            )
            jobs.append(job)
            earlier = (job.id,)
    return jobs


def start_levels(jobs: Sequence[Job]) -> dict[str, int]:
    """{job: level}, 0 for what starts first: the jobs with most expected seconds to the end of their capture, in classes of equal size.

    Longest first keeps the workers busy to the end: a long capture that starts last would be waited for alone (Graham, *Bounds on
    Multiprocessing Timing Anomalies*, 1969, section 5).
    """
    left: dict[str, float] = {}  # of the job and all that need it
    after: dict[str, float] = {}
    for job in reversed(jobs):
        left[job.id] = job.seconds + after.get(job.id, 0.0)
        for need in job.needs:
            after[need] = max(after.get(need, 0.0), left[job.id])
    ranked = sorted(left, key=lambda name: -left[name])
    first = {seconds: rank for rank, seconds in reversed(list(enumerate(left[name] for name in ranked)))}
    return {name: first[left[name]] * LEVELS // len(ranked) for name in ranked}  # what is equal is in one class


def stage_command(until: str, plan: CapturePlan, options: BatchOptions, threads: int) -> tuple[str, ...]:
    """The command that brings a capture's stages up to `until` up to date; every job names all options, so none depends on another. Only
    a store whose address has credentials is left to GSBAKE_STORE."""
    words = ["gsbake", until, str(plan.photos), "--out", str(plan.out), "--profile", options.profile, "--seed", str(options.seed)]
    for override in options.overrides:
        words += ["--set", override]
    words += ["--threads", str(threads), "--quiet", *(["--moved"] if options.moved else [])]
    return tuple(words + (["--store", options.named_store] if options.named_store else []))


def group_stages(seconds: Sequence[float], pack_seconds: float) -> list[range]:
    """Consecutive stages, by their expected seconds, in groups: a group takes stages until it is expected to last `pack_seconds`; a short
    last group joins the one before."""
    groups: list[range] = []
    start = 0
    for end in range(1, len(seconds) + 1):
        if sum(seconds[start:end]) >= pack_seconds:
            groups.append(range(start, end))
            start = end
    if start < len(seconds):
        first = groups.pop().start if groups else start
        groups.append(range(first, len(seconds)))
    return groups
