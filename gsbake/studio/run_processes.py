"""The processes of runs: each is `gsbake run` in a session of its own, which outlives the server and tells of itself in live.json."""

from __future__ import annotations

import subprocess
import tempfile
import threading
from contextlib import suppress
from typing import IO, Any

import psutil

from gsbake.errors import UsageError
from gsbake.python_process import python_command, python_environment
from gsbake.studio.live import LiveRun
from gsbake.studio.picture import Source, draw_in_process, newest_source
from gsbake.studio.sessions import session_of
from gsbake.studio.workspace import Capture, NotFoundError
from gsbake.system.processes import start_apart

#: Seconds in which a run that has written its end exits.
LAST_SECONDS = 0.5
#: Bytes of the error output that is looked at for the reason of a run that did not start.
_TAIL = 4000


class Runs:
    """The processes that this server has started, until they have written their live.json; and the last picture of each run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._started: dict[str, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}
        self._pictures: dict[str, tuple[Source, bytes]] = {}
        self._drawing = threading.Lock()

    def start(self, capture: Capture, until: str | None) -> None:
        """Start `gsbake run` (or the command of the stage `until`) with the stored settings. Raises UsageError while one is in progress."""
        with self._lock:
            if self._starting(capture) or is_running(capture):
                raise UsageError(f"A run of {capture.name} is in progress; stop it first.")
            errors = tempfile.TemporaryFile()  # noqa: SIM115 (the process keeps it when the server ends)
            command = python_command("-m", "gsbake", until or "run", "--out", str(capture.out), "--quiet")
            child = start_apart(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors, env=python_environment(), cwd=capture.root
            )
            self._started[capture.name] = child, errors

    def state(self, capture: Capture) -> dict[str, Any]:
        """What live.json says, whether the run goes on, and why one did not start."""
        with self._lock:
            starting, live = self._starting(capture), LiveRun.read(capture.out)
            known = self._started.get(capture.name)
            if known is not None and live is not None and live.holder is not None and live.holder.pid == known[0].pid:
                starting = False
                if known[0].poll() is not None:  # its end is in live.json
                    self._forget(capture)
                    known = None
            message = "" if known is None or starting else self._reason(known)
        state: dict[str, Any] = {"starting": starting, "runs": False, "message": message}
        if live is not None and not starting:  # else it is that of the run before
            state |= {**live.document, "runs": live.runs, "message": message or live.document.get("message", "")}
            state["killed"] = not live.runs and not live.document.get("ended", True)
        return state

    def stop(self, capture: Capture) -> None:
        """Ask a run to stop, as Ctrl-C does. Raises UsageError where none is in progress, or it is another machine's."""
        live = LiveRun.read(capture.out)
        if live is None or not live.runs or live.holder is None:
            raise UsageError(f"No run of {capture.name} is in progress.")
        if live.holder.alive() is None:
            raise UsageError(f"{live.holder} computes {capture.name}; stop it there.")
        with suppress(psutil.Error):
            psutil.Process(live.holder.pid).terminate()

    def picture(self, capture: Capture) -> bytes:
        """The present picture of a run as JPEG. Raises NotFoundError where there is none yet."""
        live = LiveRun.read(capture.out)
        since = 0.0 if live is None else float(live.document.get("written", 0)) - float(live.document.get("seconds", 0))
        source = newest_source(capture.out, since)
        with self._drawing:
            last = self._pictures.get(capture.name)
            if source is not None and (last is None or last[0] != source):
                transfer = session_of(capture).profile.profile.surfels.transfer
                image = draw_in_process(capture.out, source.path, transfer)
                if image is not None:
                    last = self._pictures[capture.name] = source, image
        if source is None or last is None:
            raise NotFoundError(f"There is no picture of {capture.name} yet.")
        return last[1]

    def close(self) -> None:
        """Let go of the processes; those that run go on."""
        with self._lock:
            for child, errors in self._started.values():
                with suppress(subprocess.TimeoutExpired):  # it may be about to end
                    child.wait(LAST_SECONDS)
                errors.close()
            self._started.clear()

    def _starting(self, capture: Capture) -> bool:
        known = self._started.get(capture.name)
        return known is not None and known[0].poll() is None and not is_running(capture)

    def _reason(self, known: tuple[subprocess.Popen[bytes], IO[bytes]]) -> str:
        """The last line of what a process that has ended wrote to stderr."""
        child, errors = known
        if child.poll() in (None, 0):
            return ""
        size = errors.seek(0, 2)
        errors.seek(max(0, size - _TAIL))
        return errors.read().decode(errors="replace").strip().rpartition("\n")[2].removeprefix("gsbake: ")

    def _forget(self, capture: Capture) -> None:
        self._started.pop(capture.name)[1].close()


def is_running(capture: Capture) -> bool:
    """Whether a run of the capture's output folder is in progress, whoever started it."""
    live = LiveRun.read(capture.out)
    return live is not None and live.runs
