"""Jobs of a batch in the formats of schedulers: JSON, a shell script, a Snakefile, sbatch commands, an OpenCue list, an OpenJD template.

OpenCue's `cuecmd` runs the lines of a list in any order, so a line is a whole capture. OpenJD allows 100 steps in a template: where there
are more jobs, one step bakes whole captures, one task per capture (at most 1024).

A name of a file may hold anything but "/" and a zero byte. Each format quotes what it can and refuses the rest, so that no name becomes
another one, or a command.
"""

from __future__ import annotations

import json
import shlex
import unicodedata
from collections.abc import Callable, Sequence
from typing import Any

from gsbake.batch.jobs import Job
from gsbake.errors import UsageError

#: Limits of an OpenJD job template (Open Job Description specification 2023-09).
_MAX_STEPS, _MAX_TASKS = 100, 1024
#: Exit codes after which Slurm's script puts a job into the queue again.
_RETRY = 75


def emit(form: str, jobs: Sequence[Job]) -> str:
    """The jobs in one of FORMATS. Raises UsageError for an unknown one, and for jobs that a format cannot hold."""
    if form not in FORMATS:
        raise UsageError(f"--emit is one of {', '.join(FORMATS)}, not '{form}'.")
    return FORMATS[form](jobs)


def as_json(jobs: Sequence[Job]) -> str:
    """{"format": 1, "jobs": […]}, a job's dependencies before it."""
    return json.dumps({"format": 1, "jobs": [job.document() for job in jobs]}, indent=1) + "\n"


def as_sh(jobs: Sequence[Job]) -> str:
    """A POSIX script that bakes one capture after another; a failed one does not stop the rest, and the script then exits with 1."""
    lines = ["#!/bin/sh", "failed=0"]
    for _, own in _by_capture(jobs):
        comments = [f"# {job.id}: {job.threads} threads, {job.memory_mb} MB, about {job.seconds:.0f} s" for job in own]
        lines += [*comments, " && ".join(shlex.join(job.command) for job in own) + " || failed=1"]
    return "\n".join([*lines, "exit $failed"]) + "\n"


def as_snakemake(jobs: Sequence[Job]) -> str:
    """A Snakefile with one rule per job; `snakemake --snakefile FILE --cores N --keep-going`. Markers of finished jobs are in .gsbake/."""
    done = [f".gsbake/{job.id}.done" for job in jobs]
    rules = [f"rule all:\n    input: {done!r}\n"]
    for job in jobs:
        command = shlex.join(job.command).replace("{", "{{").replace("}", "}}")
        needs = [f".gsbake/{name}.done" for name in job.needs]
        rules.append(
            f"rule {job.id}:\n    input: {needs!r}\n    output: touch({f'.gsbake/{job.id}.done'!r})\n    threads: {job.threads}\n"
            f"    resources: mem_mb={job.memory_mb}, runtime={job.minutes}\n    shell: {command!r}\n"
        )
    return "\n".join(rules)


def as_slurm(jobs: Sequence[Job]) -> str:
    """A POSIX script of sbatch commands. A job that exits with 75 is put into the queue again, up to three times; Slurm drops the
    dependants of one that failed."""
    names = {job.id: f"j{number}" for number, job in enumerate(jobs)}
    lines = ["#!/bin/sh", "set -e"]
    for job in jobs:
        waits = f" --dependency=afterok:{':'.join(f'${names[need]}' for need in job.needs)} --kill-on-invalid-dep=yes" if job.needs else ""
        again = (
            f'code=$?; [ $code -ne {_RETRY} ] || [ "${{SLURM_RESTART_COUNT:-0}}" -ge 3 ] || scontrol requeue "$SLURM_JOB_ID"; exit $code'
        )
        lines.append(
            f"{names[job.id]}=$(sbatch --parsable --requeue --job-name={job.id} --cpus-per-task={job.threads} --mem={job.memory_mb}M "
            f"--time={job.minutes}{waits} --wrap={shlex.quote(f'{shlex.join(job.command)}; {again}')})"
        )
    return "\n".join(lines) + "\n"


def as_opencue(jobs: Sequence[Job]) -> str:
    """A list for `cuecmd`: one line per capture, which runs its jobs one after another. Raises UsageError for names with line breaks, and
    for those that are no text."""
    lines = [" && ".join(shlex.join(job.command) for job in own) for _, own in _by_capture(jobs)]
    _refuse(jobs, "OpenCue", lambda word: len(f"{word}x".splitlines()) > 1 or not _is_text(word), "a line break or is no text")
    return "".join(f"{line}\n" for line in lines)


def as_openjd(jobs: Sequence[Job]) -> str:
    """An OpenJD job template as JSON. Raises UsageError for more captures than it can hold, and for paths with "{{", with control
    characters, or that are no text."""
    _refuse(jobs, "OpenJD", lambda word: "{{" in word, "'{{', which starts a variable")
    _refuse(jobs, "OpenJD", lambda word: not _is_text(word) or _has_control(word), "a control character or is no text")
    if not jobs:
        raise UsageError("Nothing is left to run, and an OpenJD template needs a step.")
    steps = [_step(job) for job in jobs] if len(jobs) <= _MAX_STEPS else [_step_of_captures(jobs)]
    return json.dumps({"specificationVersion": "jobtemplate-2023-09", "name": "gsbake", "steps": steps}, indent=1) + "\n"


def _step(job: Job) -> dict[str, Any]:
    step: dict[str, Any] = {"name": job.id[:64], "script": {"actions": {"onRun": _action(job.command, job.minutes)}}}
    step["hostRequirements"] = _requirements(job.threads, job.memory_mb)
    if job.needs:
        step["dependencies"] = [{"dependsOn": need[:64]} for need in job.needs]
    return step


def _step_of_captures(jobs: Sequence[Job]) -> dict[str, Any]:
    """One step with a task per capture: the last job's command brings all stages of its capture up to date."""
    captures = _by_capture(jobs)
    if len(captures) > _MAX_TASKS:
        raise UsageError(f"An OpenJD template holds {_MAX_TASKS} captures, not {len(captures)}; split the batch.")
    last = [own[-1] for _, own in captures]
    words = list(last[0].command)
    words[words.index(last[0].photos)] = "{{Task.Param.Photos}}"
    words[words.index(last[0].out)] = "{{Task.Param.Out}}"
    minutes = max(sum(job.minutes for job in own) for _, own in captures)
    return {
        "name": "bake",
        "parameterSpace": {
            "taskParameterDefinitions": [
                {"name": "Photos", "type": "STRING", "range": [job.photos for job in last]},
                {"name": "Out", "type": "STRING", "range": [job.out for job in last]},
            ],
            "combination": "(Photos, Out)",
        },
        "hostRequirements": _requirements(max(job.threads for job in jobs), max(job.memory_mb for job in jobs)),
        "script": {"actions": {"onRun": _action(("gsbake", "run", *words[2:]), minutes)}},
    }


def _action(command: Sequence[str], minutes: int) -> dict[str, Any]:
    return {"command": command[0], "args": list(command[1:]), "timeout": 60 * minutes}


def _requirements(threads: int, memory_mb: int) -> dict[str, Any]:
    return {"amounts": [{"name": "amount.worker.vcpu", "min": threads}, {"name": "amount.worker.memory", "min": memory_mb}]}


def _refuse(jobs: Sequence[Job], form: str, wrong: Callable[[str], bool], what: str) -> None:
    """Raise UsageError for the first word of a command that a format cannot hold."""
    for word in (word for job in jobs for word in job.command):
        if wrong(word):
            raise UsageError(f"'{word}' holds {what}, which {form} cannot quote; rename it or choose another format.")


def _is_text(word: str) -> bool:
    """Whether a word is text, not bytes that Python carries in surrogates."""
    return not any("\ud800" <= character <= "\udfff" for character in word)


def _has_control(word: str) -> bool:
    return any(unicodedata.category(character) == "Cc" for character in word)


def _by_capture(jobs: Sequence[Job]) -> list[tuple[str, list[Job]]]:
    """(capture, its jobs in order)."""
    found: dict[str, list[Job]] = {}
    for job in jobs:
        found.setdefault(job.capture, []).append(job)
    return list(found.items())


FORMATS: dict[str, Callable[[Sequence[Job]], str]] = {
    "json": as_json,
    "sh": as_sh,
    "snakemake": as_snakemake,
    "slurm": as_slurm,
    "opencue": as_opencue,
    "openjd": as_openjd,
}
