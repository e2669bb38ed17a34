"""Control of the COLMAP process (`sfm.worker`): start, progress, stop requests and time limit."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.python_process import python_command, python_environment

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


def _kill(child: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


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
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()] if log.exists() else []
    return lines[-1] if lines else "no message"


def run_job(job: Mapping[str, Any], out: Path, callbacks: JobCallbacks, limit: float | None = None) -> dict[str, Any] | None:
    """Run a job of `sfm.worker` with its result in the folder `out`; None when it was stopped on request.

    Raises InterruptedRun when the process was killed, ran out of memory or disk, or took longer than `limit` seconds: that is no answer
    and must not be stored as one. Raises SolveFailedError when it failed otherwise.
    """
    out.mkdir(parents=True, exist_ok=True)
    job_file = out / "job.json"
    job_file.write_text(json.dumps({**job, "out": str(out)}))
    log = out / "colmap.log"
    log_progress = _LogProgress(log)
    deadline = None if limit is None else time.monotonic() + limit
    command = python_command("-m", "gsbake.capture.sfm.worker", str(job_file), str(os.getpid()))
    environment = python_environment(_ONE_THREAD)
    with log.open("wb") as sink:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=sink, env=environment, start_new_session=True
        )
    try:
        assert child.stdout is not None
        os.set_blocking(child.stdout.fileno(), False)
        with selectors.DefaultSelector() as selector:
            selector.register(child.stdout, selectors.EVENT_READ)
            rest = b""
            while True:
                if callbacks.stop():
                    return None
                if deadline is not None and time.monotonic() > deadline:
                    raise InterruptedRun(f"Structure from motion took longer than {limit:.0f} s; run the same command on an idle machine.")
                if not selector.select(_POLL_SECONDS):
                    if (progress := log_progress.poll()) is not None:
                        callbacks.progress(*progress)
                    continue
                data = child.stdout.read()
                if data == b"":
                    break
                *lines, rest = (rest + (data or b"")).split(b"\n")
                for line in lines:
                    with suppress(ValueError, KeyError, TypeError):  # output of libraries
                        report = json.loads(line)
                        log_progress.begin(report["part"], report["total"])
                        callbacks.progress(report["part"], report["done"], report["total"])
        code = child.wait()
    finally:
        _kill(child)
        if child.stdout is not None:
            child.stdout.close()
    result = out / "result.json"
    if code < 0 or code == InterruptedRun.exit_code:
        reason = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"failed ({_last_line(log)})"
        raise InterruptedRun(f"Structure from motion {reason}; the same command resumes it; free memory and disk if it fails again.")
    if code != 0 or not result.exists():
        raise SolveFailedError(f"Structure from motion failed ({_last_line(log)}); its log is '{log}'.")
    return dict(json.loads(result.read_text()))
