"""What `gsbake batch` asks Slurm itself, beside Snakemake: how it records ended jobs, its nodes, and the batch's jobs in the queue."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbake.errors import UsageError

#: Seconds for an answer of slurmctld, and for cancelled jobs to write their checkpoints and end.
_ANSWER_TIMEOUT, _CANCEL_TIMEOUT = 60.0, 60.0
#: Seconds from a job's submission to the first look at its state; Snakemake doubles the pause and more while nothing ends.
FIRST_LOOK = 10
#: More than the jobs that a batch usually has in the queue at a time.
_BASIC_NICE = 200
#: Names of partitions (several with commas), accounts and nodes, which end in commands of a shell.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.,-]*")


@dataclass(frozen=True)
class SlurmOptions:
    """The user's choices for all jobs: partition and account; None takes Slurm's defaults."""

    partition: str | None = None
    account: str | None = None


@dataclass(frozen=True)
class Cluster:
    """What is asked once: the command that knows the states of ended jobs, the number of nodes, the memory of the largest in MB, all
    their cores, and the `sbatch --nice` by which a job stands behind those of the level before it."""

    status_command: str
    nodes: int
    largest_mb: int
    cores: int
    nice: int = 1


def ask_cluster(options: SlurmOptions) -> Cluster:
    """The properties of the cluster. Raises UsageError for a name that Slurm has not, without its commands, or when slurmctld does not
    answer."""
    for option, name in (("--partition", options.partition), ("--account", options.account)):
        if name is not None and not _NAME.fullmatch(name):
            raise UsageError(f"{option} takes a name of Slurm's (letters, digits, '_', '-', '.', ','), not '{name}'.")
    if shutil.which("sbatch") is None:
        raise UsageError(
            "--executor slurm needs Slurm's command sbatch on the PATH; install Slurm's client tools, or use --executor local."
        )
    config = _ask("scontrol", "show", "config")
    chosen = ("--partition", options.partition) if options.partition is not None else ()
    rows = _ask("sinfo", "--noheader", "--Node", "--format=%N %m %c", *chosen)
    if config is None or rows is None:
        raise UsageError("Slurm does not answer (`scontrol show config`); look whether slurmctld runs, or use --executor local.")
    nodes = {words[0]: (_number(words[1]), _number(words[2])) for line in rows.splitlines() if len(words := line.split()) == 3}
    if not nodes:
        raise UsageError(f"Slurm has no nodes{f' in the partition {options.partition}' if options.partition else ''}; name another.")
    # Without accounting, sacct only fails, and Snakemake would wait for ever.
    accounted = re.search(r"^AccountingStorageType\s*=\s*(?!accounting_storage/none|\(null\))\S", config, re.MULTILINE)
    status_command = "sacct" if accounted and shutil.which("sacct") else "squeue"
    # priority/basic lowers the priority by 1 with each job submitted; elsewhere jobs of a user start as equals.
    nice = _BASIC_NICE if re.search(r"^PriorityType\s*=\s*priority/basic", config, re.MULTILINE) else 1
    memory, cores = zip(*nodes.values(), strict=True)
    return Cluster(status_command, len(nodes), max(memory), sum(cores), nice)


def job_prefix(root: Path) -> str:
    """Start of the names of all jobs that batches in a folder submit."""
    return f"gsbake-{hashlib.blake2b(os.fsencode(root.absolute()), digest_size=6).hexdigest()}"


def queued_jobs(prefix: str) -> list[str] | None:
    """Identifiers of the user's waiting, running and ending jobs with the prefix; None when Slurm does not answer."""
    rows = _ask("squeue", "--noheader", "--me", "--format=%A %j")
    if rows is None:
        return None
    return sorted({words[0] for line in rows.splitlines() if len(words := line.split()) == 2 and words[1].startswith(prefix)})


def cancel_jobs(prefix: str) -> None:
    """Cancel the jobs with the prefix and wait until they have ended; they write checkpoints."""
    deadline = time.monotonic() + _CANCEL_TIMEOUT
    cancelled: set[str] = set()
    while (jobs := queued_jobs(prefix)) and time.monotonic() < deadline:
        if new := [job for job in jobs if job not in cancelled]:
            _ask("scancel", *new)
            cancelled |= set(new)
        time.sleep(0.5)


def snakemake_arguments(cluster: Cluster, prefix: str) -> Sequence[str]:
    """Options of Snakemake's Slurm executor."""
    return (
        "--slurm-status-command", cluster.status_command, "--slurm-init-seconds-before-status-checks", str(FIRST_LOOK),
        "--slurm-jobname-prefix", prefix,
        "--slurm-requeue",  # a job that is pre-empted without it is neither ended nor started again, as Snakemake sees it
    )  # fmt: skip


def submit_options(nice: int, failed_on: object, nodes: int) -> str:
    """Options of `sbatch` for a job: its order in the queue, and the nodes on which it was interrupted, unless all `nodes` are among them.
    `failed_on` is from a record on disk: what is no name of Slurm's is left out, because Snakemake's plugin hands it to a shell."""
    names = failed_on if isinstance(failed_on, list) else []
    failed = [name for name in names if isinstance(name, str) and _NAME.fullmatch(name)]
    return f"--nice={nice} --exclude={','.join(failed)}" if failed and len(failed) < nodes else f"--nice={nice}"


def node_name() -> str:
    """Slurm's name of the node that this process runs on; empty outside of Slurm."""
    name = os.environ.get("SLURMD_NODENAME", "")
    return name if _NAME.fullmatch(name) else ""


def _number(text: str) -> int:
    """The number of "24000+"."""
    return int(re.sub(r"\D", "", text) or 0)


def _ask(*command: str) -> str | None:
    """Output of one of Slurm's commands; None when it fails or slurmctld does not answer."""
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_ANSWER_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
