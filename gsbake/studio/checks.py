"""Checks of captures, `gsbake check` in processes of their own; the output of the last one is kept in the cache."""

from __future__ import annotations

import json
import subprocess
import threading
from contextlib import suppress
from typing import Any

from gsbake.atomic import write_atomic
from gsbake.python_process import python_command, python_environment
from gsbake.studio.workspace import Capture

#: File in the cache with the output of the last check.
CHECK = "check.json"


class Checks:
    """Runs `gsbake check`, one for each capture at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._errors: dict[str, str] = {}

    def start(self, capture: Capture) -> None:
        """Check a capture's photos unless that is in progress; its output comes to lie in the cache."""
        with self._lock:
            if capture.name in self._running:
                return
            command = python_command("-m", "gsbake", "check", str(capture.source), "--json")
            child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=python_environment(), cwd=capture.root)
            self._running[capture.name] = child
            self._errors.pop(capture.name, None)
        threading.Thread(target=self._finish, args=(capture, child), name="check", daemon=True).start()

    def state(self, capture: Capture) -> dict[str, Any]:
        """Whether a check is in progress, the error of the last one, and what the last complete one found."""
        found = None
        with suppress(OSError, ValueError, RecursionError):
            found = json.loads((capture.cache / CHECK).read_bytes())
        with self._lock:
            return {"running": capture.name in self._running, "error": self._errors.get(capture.name, ""), "found": found}

    def close(self) -> None:
        """End what is in progress."""
        with self._lock:
            for child in self._running.values():
                child.kill()

    def _finish(self, capture: Capture, child: subprocess.Popen[bytes]) -> None:
        output, errors = child.communicate()
        error = ""
        if child.returncode == 0:
            with suppress(OSError):
                capture.cache.mkdir(parents=True, exist_ok=True)
                write_atomic(capture.cache / CHECK, output)
        else:
            error = errors.decode(errors="replace").strip().rpartition("\n")[2].removeprefix("gsbake: ") or "The check was ended."
        with self._lock:
            self._running.pop(capture.name, None)
            if error:
                self._errors[capture.name] = error
