"""Child processes: started apart from the terminal's Ctrl-C, asked to stop, ended with their own children, ended with their parent."""

from __future__ import annotations

import ctypes
import os
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import psutil

#: Seconds between looks at the parent.
_PARENT_POLL = 0.5
#: Option of prctl(2): the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1
#: How a child is asked to stop, where a group of processes can be sent a signal; on Windows, a key of the console that the group shares.
_STOP = getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM)
#: The signal that ends a process at once; None on Windows.
_KILL: int | None = getattr(signal, "SIGKILL", None)


def stop_signals() -> tuple[int, ...]:
    """The signals by which a user, a terminal or a scheduler asks this process to stop; Windows has SIGBREAK, the others SIGHUP."""
    return tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))


def start_apart(
    command: Sequence[str], *, stdin: int, stdout: int | IO[bytes], stderr: int | IO[bytes], env: Mapping[str, str], cwd: Path | None = None
) -> subprocess.Popen[bytes]:
    """Start a child in a process group of its own: Ctrl-C at the terminal reaches only this process, which passes it on."""
    return subprocess.Popen(
        command, stdin=stdin, stdout=stdout, stderr=stderr, env=env, cwd=cwd, start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    )  # fmt: skip


def shell_line(command: Sequence[str]) -> str:
    """A command as the system's shell reads it: `sh`, or `cmd` on Windows."""
    return shlex.join(command) if os.name == "posix" else subprocess.list2cmdline(command)


def process_tree(pid: int) -> list[psutil.Process]:
    """A process and all its descendants; those that have ended meanwhile are left out."""
    with suppress(psutil.Error):
        root = psutil.Process(pid)
        return [root, *root.children(recursive=True)]
    return []


def resident_memory(pid: int) -> int:
    """Resident memory of a process and its descendants in bytes."""
    total = 0
    for process in process_tree(pid):
        with suppress(psutil.Error):
            total += process.memory_info().rss
    return total


def kill(child: subprocess.Popen[bytes]) -> None:
    """Kill a child of `start_apart` with its descendants, and wait for it."""
    tree = process_tree(child.pid) if child.poll() is None else []
    _signal_group(child.pid, _KILL)  # also descendants whose own parent has ended
    for process in tree:
        with suppress(psutil.Error):
            process.kill()
    child.wait()


def stop_group(pid: int, timeout: float) -> None:
    """Ask a process that `start_apart` has started, and its descendants, to stop; kill those that still run after `timeout` seconds."""
    tree = process_tree(pid)
    if not _signal_group(pid, signal.SIGTERM):
        with suppress(OSError):
            os.kill(pid, _STOP)
    _, running = psutil.wait_procs(tree, timeout)
    if running:
        _signal_group(pid, _KILL)
    for process in running:
        with suppress(psutil.Error):
            process.kill()
    psutil.wait_procs(running, 5.0)


def leads_group(pid: int) -> bool:
    """Whether a process leads a process group, as one of `start_apart` does; True where the system cannot tell."""
    getpgid = getattr(os, "getpgid", None)
    return bool(getpgid is None or getpgid(pid) == pid)


def _signal_group(pid: int, number: int | None) -> bool:
    """Send a signal to the process group of this leader; False where the system has no groups."""
    killpg = getattr(os, "killpg", None)
    if killpg is None or number is None:
        return False
    with suppress(ProcessLookupError, PermissionError):
        killpg(pid, number)
    return True


def kill_with_parent() -> None:
    """Have the kernel kill this process when the thread that started it ends; it does so on Linux alone."""
    with suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, _KILL, 0, 0, 0)


def exit_with_parent(parent: int, code: int) -> None:
    """End this process with exit code `code` when the process `parent` has ended, so that a killed run leaves no process behind."""
    watched = None
    if os.name != "posix":  # a child keeps its parent's number for ever, and Python in a virtual environment is the child of its launcher
        try:
            watched = psutil.Process(parent)
        except psutil.NoSuchProcess:
            os._exit(code)

    def lives() -> bool:
        return os.getppid() == parent if watched is None else watched.is_running()

    def poll() -> None:
        while lives():
            time.sleep(_PARENT_POLL)
        os._exit(code)

    if not lives():
        os._exit(code)
    threading.Thread(target=poll, name="parent poll", daemon=True).start()


def lower_priority() -> None:
    """Let other processes go first."""
    with suppress(psutil.Error, OSError):
        psutil.Process().nice(getattr(psutil, "IDLE_PRIORITY_CLASS", 15))


def set_handlers(handler: Any) -> dict[int, Any]:
    """Set the handler of all stop signals; returns the ones before. Only the main thread may."""
    return {number: signal.signal(number, handler) for number in stop_signals()}
