# Workflow of `gsbake batch`: one rule per job of the file that the coordinator wrote (gsbake/batch/coordinator.py).
# The marker of a finished job only orders the jobs of this run; whether a stage is done is what gsbake's store says.
import json

with open(config["jobs"], encoding="utf-8") as file:
    BATCH = json.load(file)


rule all:
    input: [f"{job['id']}.done" for job in BATCH["jobs"]]


for job in BATCH["jobs"]:
    rule:
        name: job["id"]
        input: [f"{need}.done" for need in job["needs"]]
        output: touch(f"{job['id']}.done")
        threads: job["threads"]
        retries: BATCH["retries"]
        resources:
            mem_mb=lambda wildcards, attempt, memory=job["memory_mb"]: memory * (attempt if BATCH["grow_memory"] else 1),
            runtime=lambda wildcards, attempt, minutes=job["minutes"]: minutes * attempt,
        params: command=job["shell"]
        shell: "{params.command}"
