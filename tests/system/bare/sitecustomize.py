"""Takes from Python what Windows has not: every process that finds this folder on its path is without `resource`, `prctl`, process groups,
CPU affinity and SIGHUP, and SIGTERM only kills it. BARE_LOG names a file to which each such process adds a line."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from typing import Any

import psutil  # noqa: F401 - it uses what its system has

_CDLL, _SIGNAL, _POPEN = ctypes.CDLL, signal.signal, subprocess.Popen


def _library(name: Any, *arguments: Any, **options: Any) -> Any:
    if name is None:
        raise TypeError("there is no library of the process itself")
    return _CDLL(name, *arguments, **options)


def _handle(number: int, handler: Any) -> Any:
    return signal.SIG_DFL if number == signal.SIGTERM else _SIGNAL(number, handler)


class _Popen(_POPEN):  # type: ignore[type-arg]
    def __init__(self, *arguments: Any, **options: Any) -> None:
        if options.get("pass_fds"):
            raise ValueError("pass_fds is not supported on this system")
        super().__init__(*arguments, **{**options, "start_new_session": False})


sys.modules["resource"] = None  # type: ignore[assignment]
ctypes.CDLL, signal.signal, subprocess.Popen = _library, _handle, _Popen  # type: ignore[misc, assignment]
for module, name in ((os, "killpg"), (os, "getpgid"), (os, "setsid"), (os, "sched_getaffinity"), (signal, "SIGHUP")):
    delattr(module, name)
if "BARE_LOG" in os.environ:
    with open(os.environ["BARE_LOG"], "a", encoding="utf-8") as file:
        file.write(f"{os.getpid()}\n")
