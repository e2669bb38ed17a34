"""Control of the COLMAP process (`sfm.worker`): start, progress, stop requests and time limit."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.python_process import python_command, python_environment
from gsbake.system import processes
from gsbake.system.exit_codes import ExitCode
from gsbake.system.pipes import LineReader

#: Work is split between pairs and photos, so the matrix library's own threads would only get in the way.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
#: Seconds between checks for stop requests.
_POLL_SECONDS = 0.2


class SolveFailedError(GsbakeError):
    """The COLMAP process ended without a result; the message ends with the last line of its log."""


@dataclass(frozen=True)
class JobCallbacks:
    """Callbacks while COLMAP runs: `progress` receives (part, done, total), `stop` returns whether to stop."""

    progress: Callable[[str, int, int], None]
    stop: Callable[[], bool]


class _LogProgress:
    """Progress read from COLMAP's log, since its long calls take no callback. (Reading its database instead is invalid: a second SQLite
    in the same process breaks the locks of the first.)"""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._part, self._total, self._files = "", 0, 0

    def begin(self, part: str, total: int) -> None:
        """Attribute the counts of the log from now on to this part."""
        if part != self._part:
            self._part, self._total, self._files = part, total, 0

    def poll(self) -> tuple[str, int, int] | None:
        """Progress (part, done, total) of the current part, or None when the log has no new count."""
        with self._path.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
        text = text[: text.rfind(b"\n") + 1]
        self._offset += len(text)
        if self._part != "features" or not text:
            return None
        self._files += text.count(b"Processed file [")
        return self._part, min(self._files, self._total), self._total


def _last_line(log: Path) -> str:
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no message"


def run_job(job: Mapping[str, Any], out: Path, callbacks: JobCallbacks, limit: float | None = None) -> dict[str, Any] | None:
    """Run a job of `sfm.worker` with its result in the folder `out`; None when it was stopped on request.

    Raises InterruptedRun when the process was killed, ran out of memory or disk, or took longer than `limit` seconds: that is no answer
    and must not be stored as one. Raises SolveFailedError when it failed otherwise.
    """
    out.mkdir(parents=True, exist_ok=True)
    job_file = out / "job.json"
    job_file.write_bytes(json.dumps({**job, "out": str(out)}).encode())
    log = out / "colmap.log"
    log_progress = _LogProgress(log)
    deadline = None if limit is None else time.monotonic() + limit
    command = python_command("-m", "gsbake.capture.sfm.worker", str(job_file), str(os.getpid()))
    environment = python_environment(_ONE_THREAD)
    with log.open("wb") as sink:
        child = processes.start_apart(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=sink, env=environment)
    assert child.stdout is not None
    reader = LineReader(child.stdout)
    try:
        while not reader.ended:
            if callbacks.stop():
                return None
            if deadline is not None and time.monotonic() > deadline:
                raise InterruptedRun(f"Structure from motion took longer than {limit:.0f} s; run the same command on an idle machine.")
            lines = reader.lines(_POLL_SECONDS)
            if not lines and (progress := log_progress.poll()) is not None:
                callbacks.progress(*progress)
            for line in lines:
                with suppress(ValueError, KeyError, TypeError):  # output of libraries
                    report = json.loads(line)
                    log_progress.begin(report["part"], report["total"])
                    callbacks.progress(report["part"], report["done"], report["total"])
        code = ExitCode.of(child.wait())
    finally:
        processes.kill(child)
        reader.close()
    result = out / "result.json"
    if code.signal or code.code == InterruptedRun.exit_code:
        reason = f"was ended by {code}" if code.signal else f"failed ({_last_line(log)})"
        raise InterruptedRun(f"Structure from motion {reason}; the same command resumes it; free memory and disk if it fails again.")
    if code.code != 0 or not result.exists():
        raise SolveFailedError(f"Structure from motion failed ({_last_line(log)}); its log is '{log}'.")
    return dict(json.loads(result.read_text(encoding="utf-8")))
