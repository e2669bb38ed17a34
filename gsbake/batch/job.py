"""One job of a batch, as the scheduler starts it: `python -m gsbake.batch.job JOBS ID` brings stages up to date and records how it ended.

The exit code is that of `gsbake run`. A job that failed for good exits at once with the same code when the scheduler tries it again, so
that bad input is never computed twice; a job that was interrupted (75) or killed goes on where it stopped.
"""

from __future__ import annotations

import json
import socket
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from gsbake.api import RunOptions, open_session
from gsbake.batch.captures import plan_state_key
from gsbake.batch.records import Record, read_record
from gsbake.batch.slurm import node_name
from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.pipeline.events import now
from gsbake.pipeline.registry import Registry


def run_job(document: dict[str, Any], job_id: str) -> Record:
    """Run a job of the coordinator's document and write its record."""
    root = Path(document["root"])
    earlier = read_record(root, job_id)
    if earlier is not None and earlier.final:
        return earlier
    job = next(job for job in document["jobs"] if job["id"] == job_id)
    start, code, message, key = time.perf_counter(), 0, "", ""
    try:
        options = RunOptions(
            Path(job["photos"]), Path(job["out"]), document["profile"], document["overrides"], threads=job["threads"],
            seed=document["seed"], store=document["store"], moved=document["moved"],
        )  # fmt: skip
        session = open_session(options, registry=Registry(document["stages"]))
        try:
            message = " ".join(session.run(job["stages"][-1]).notes)
        except GsbakeError:
            key = plan_state_key(session)
            raise
    except GsbakeError as error:
        code, message = error.exit_code, str(error)
    except Exception as error:
        traceback.print_exc()  # into the log of the scheduler
        code, message = 1, f"Internal error ({type(error).__name__}: {error})."
    failed_on = earlier.failed_on if earlier is not None else ()
    if code == InterruptedRun.exit_code and node_name():
        failed_on = tuple(dict.fromkeys((*failed_on, node_name())))
    host = node_name() or socket.gethostname()
    record = Record(job["capture"], job_id, code, message, round(time.perf_counter() - start, 3), host, now(), key, failed_on)
    record.write(root)
    return record


def main() -> None:
    """Entry point: `JOBS ID`."""
    path, job_id = sys.argv[1:3]
    record = run_job(json.loads(Path(path).read_text(encoding="utf-8")), job_id)
    if record.message:
        sys.stderr.write(f"gsbake: {record.capture}: {record.message}\n")
    raise SystemExit(record.exit_code)


if __name__ == "__main__":
    main()
