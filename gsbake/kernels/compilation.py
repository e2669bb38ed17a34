"""Compilation of kernels in processes of their own, while other work goes on.

Numba holds a lock while it compiles, so each process compiles one module at a time (`declaration.compile_module`) and keeps the code in
Numba's cache on the disk, where every later process finds it. A record beside the cache says which modules were compiled, for which
sources, versions and processor. What a process cannot compile is compiled where it is called, which also reports the failure.

`python -m gsbake.kernels.compilation` is such a process: it reads names of modules from stdin and answers each with a line.
"""

from __future__ import annotations

import os
import platform
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from blake3 import blake3

import gsbake
from gsbake.python_process import python_command, python_environment
from gsbake.system.limits import cpu_name

#: Seconds between two looks at a stop request while waiting.
_POLL = 0.1


class Compilation:
    """Compiles `modules` in this order in `processes` processes, from `start` on; those that the record names are left out.

    Nothing is read before `start`: most runs compute nothing, or nothing with kernels.
    """

    def __init__(self, modules: Sequence[str], processes: int) -> None:
        self._modules = list(dict.fromkeys(modules))
        self._processes = processes
        self._record: Path | None = None
        self._missing: list[str] | None = None
        self._done: set[str] = set()
        self._changed = threading.Condition()
        self._children: list[subprocess.Popen[str]] = []
        self._feeders: list[threading.Thread] = []
        self._queue: queue.SimpleQueue[str] = queue.SimpleQueue()

    def start(self) -> list[str]:
        """Read the record and start the processes, once; the modules that were not compiled yet."""
        if self._missing is None:
            self._record = record_folder()
            self._missing = [name for name in self._modules if self._record is None or not (self._record / name).exists()]
            for name in self._missing:
                self._queue.put(name)
            for _ in range(min(self._processes, len(self._missing))):
                self._start_process()
        return self._missing

    def wait(self, modules: Sequence[str], check: Callable[[], None], report: Callable[[int, int], None]) -> None:
        """Start where that was not done, and return when `modules` are compiled, or when all processes have ended.

        While there is something to wait for, `check`, which may raise, and `report(done, total)` are called several times a second.
        """
        missing = self.start()
        needed = [name for name in dict.fromkeys(modules) if name in missing]
        while True:
            with self._changed:
                done = sum(name in self._done for name in needed)
                if done == len(needed) or not any(feeder.is_alive() for feeder in self._feeders):
                    return
                self._changed.wait(_POLL)
            check()
            report(done, len(needed))

    def close(self) -> None:
        """End the processes."""
        for child in self._children:
            child.kill()
        for feeder in self._feeders:
            feeder.join()

    def _start_process(self) -> None:
        child = subprocess.Popen(
            python_command("-m", "gsbake.kernels.compilation"), env=python_environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, encoding="utf-8",
        )  # fmt: skip
        self._children.append(child)
        self._feeders.append(threading.Thread(target=self._feed, args=(child,), daemon=True))
        self._feeders[-1].start()

    def _feed(self, child: subprocess.Popen[str]) -> None:
        """Give one process module after module until none is left or the process has ended."""
        with suppress(BrokenPipeError), child:
            while child.poll() is None and not self._queue.empty():
                with suppress(queue.Empty):
                    name = self._queue.get_nowait()
                    compiled = self._ask(child, name)
                    if compiled and self._record is not None:
                        with suppress(OSError):
                            (self._record / name).touch()
                    with self._changed:
                        self._done.add(name)
                        self._changed.notify_all()

    @staticmethod
    def _ask(child: subprocess.Popen[str], module: str) -> bool:
        """Whether the process compiled a module."""
        assert child.stdin is not None and child.stdout is not None
        try:
            child.stdin.write(f"{module}\n")
            child.stdin.flush()
            return child.stdout.readline().strip() == "compiled"
        except OSError:
            return False


def record_folder() -> Path | None:
    """Folder of the record for this code and machine, one file for each module; None where it cannot be written."""
    package = Path(gsbake.__file__).parent
    hasher = blake3()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if b"njit" in content or b"@kernel" in content:
            hasher.update(content)
    hasher.update("\n".join((sys.version, version("numba"), platform.machine(), cpu_name())).encode())
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or package / "__pycache__") / f"kernels-{hasher.hexdigest(8)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def main() -> None:
    """Compile the modules named on stdin, one a line; answers "compiled" or "failed" each."""
    from gsbake.kernels.declaration import compile_module

    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        try:
            compile_module(line.strip())
        except Exception:  # the stage that calls the kernel reports it
            answers.write("failed\n")
        else:
            answers.write("compiled\n")
        answers.flush()


if __name__ == "__main__":
    main()
