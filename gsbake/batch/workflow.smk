# Workflow of `gsbake batch`: one rule for each level of priority, whose wildcard is a job of the file that the coordinator wrote
# (gsbake/batch/workflow.py): some stages of a capture. Rules of their own for all jobs would take a time that grows with the square of
# their number. Priority is that of a rule; Snakemake starts a job of a lower level first.
# The marker of a finished job only orders the jobs of this run; whether a stage is done is what gsbake's store says.
import json
from pathlib import Path

from gsbake.batch.slurm import submit_options

with open("jobs.json", encoding="utf-8") as file:
    BATCH = json.load(file)
JOBS = {job["id"]: job for job in BATCH["jobs"]}


def memory_mb(wildcards, attempt):
    """More at each attempt where a job may have been killed for its memory, but not more than the largest node has."""
    factor = (1 + attempt) / 2 if BATCH["grow"] else 1
    return min(round(JOBS[wildcards.job]["memory_mb"] * factor), BATCH["most_memory_mb"])


def slurm_options(wildcards, attempt):
    """The order of the batch's jobs in Slurm's queue, and the nodes on which this one was interrupted: a node with a full disk would take,
    and fail, every job of the batch."""
    try:
        failed = json.loads((Path(BATCH["records"]) / f"{wildcards.job}.json").read_text(encoding="utf-8"))["failed_on"]
    except (OSError, ValueError, KeyError, TypeError):
        failed = []
    return submit_options(BATCH["nice"] * JOBS[wildcards.job]["level"], failed, BATCH["nodes"])


def marker(name):
    return f"{name}.{JOBS[name]['level']}.done"


rule all:
    input: [marker(name) for name in JOBS]


for LEVEL in sorted({job["level"] for job in JOBS.values()}):
    rule:
        name: f"level_{LEVEL}"
        input: lambda wildcards: [marker(need) for need in JOBS[wildcards.job]["needs"]]
        output: touch(f"{{job}}.{LEVEL}.done")
        wildcard_constraints: job="[A-Za-z0-9_]+"
        priority: BATCH["levels"] - LEVEL
        threads: lambda wildcards: JOBS[wildcards.job]["threads"]
        resources:
            mem_mb=memory_mb,
            runtime=lambda wildcards, attempt: JOBS[wildcards.job]["minutes"] * attempt,
            slurm_extra=slurm_options,
            **BATCH["resources"],
        params: command=lambda wildcards: JOBS[wildcards.job]["shell"]
        shell: "{params.command}"
