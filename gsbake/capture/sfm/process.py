"""Starting and watching the COLMAP process (`solve_worker`) from the poses stage."""

from __future__ import annotations

import json
import os
import re
import selectors
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError
from gsbake.python_process import python_command, python_environment

_POLL = 0.2  # seconds between looks at stop requests


class SolveFailedError(GsbakeError):
    """The COLMAP process ended without a result; the message ends with the last line it logged."""


@dataclass(frozen=True)
class Watch:
    """What to do while COLMAP runs: take progress (part, done, total), and tell whether to stop."""

    progress: Callable[[str, int, int], None]
    stop: Callable[[], bool]


def _kill(child: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


class _Log:
    """Progress from COLMAP's log, since its long calls take no callback. (Its database must not be read meanwhile: a second SQLite in
    the same process breaks the first one's locks.)"""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._part, self._total, self._files = "", 0, 0

    def begin(self, part: str, total: int) -> None:
        """A part began; what the log counts from now on belongs to it."""
        if part != self._part:
            self._part, self._total, self._files = part, total, 0

    def poll(self) -> tuple[str, int, int] | None:
        """What has been done of the current part, when the log says so."""
        with self._path.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
        text = text[: text.rfind(b"\n") + 1]
        self._offset += len(text)
        if self._part == "features":
            self._files += text.count(b"Processed file [")
            return (self._part, min(self._files, self._total), self._total) if text else None
        blocks = re.findall(rb"Processing block \[(\d+)/(\d+)\]", text) if self._part == "matching" else []
        return (self._part, int(blocks[-1][0]) - 1, int(blocks[-1][1])) if blocks else None


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()] if log.exists() else []
    return lines[-1] if lines else "no message"


def run_job(job: Mapping[str, Any], out: Path, watch: Watch, limit: float | None = None) -> dict[str, Any] | None:
    """Run a job of `solve_worker`, its result in the folder `out`; None when it was stopped or took longer than `limit` seconds.

    Raises SolveFailedError when the process crashes or fails.
    """
    out.mkdir(parents=True, exist_ok=True)
    order = out / "job.json"
    order.write_text(json.dumps({**job, "out": str(out)}))
    log = out / "colmap.log"
    counted = _Log(log)
    deadline = None if limit is None else time.monotonic() + limit
    command = python_command("-m", "gsbake.capture.sfm.worker", str(order), str(os.getpid()))
    with log.open("wb") as sink:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=sink, env=python_environment(), start_new_session=True
        )
    try:
        assert child.stdout is not None
        os.set_blocking(child.stdout.fileno(), False)
        with selectors.DefaultSelector() as ready:
            ready.register(child.stdout, selectors.EVENT_READ)
            rest = b""
            while True:
                if watch.stop() or (deadline is not None and time.monotonic() > deadline):
                    return None
                if not ready.select(_POLL):
                    if (done := counted.poll()) is not None:
                        watch.progress(*done)
                    continue
                data = child.stdout.read()
                if data == b"":
                    break
                *lines, rest = (rest + (data or b"")).split(b"\n")
                for line in lines:
                    with suppress(ValueError, KeyError, TypeError):  # anything else a library prints
                        note = json.loads(line)
                        counted.begin(note["part"], note["total"])
                        watch.progress(note["part"], note["done"], note["total"])
        code = child.wait()
    finally:
        _kill(child)
        if child.stdout is not None:
            child.stdout.close()
    result = out / "result.json"
    if code != 0 or not result.exists():
        raise SolveFailedError(f"Structure from motion ended with code {code}: {_last_line(log)}")
    return dict(json.loads(result.read_text()))
