"""Python children that parse untrusted files: with a limit on memory and time, so that a hostile file costs a sentence, not the machine.

A parser in native code may loop, exhaust memory or crash. In a child, each of these is an exit status. A `ParserProcess` answers requests
about files, one at a time, and is started again after a crash; its main is `serve`.
"""

from __future__ import annotations

import json
import os
import resource
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from gsbake.python_process import python_command, python_environment

#: Signals that a fault of the parser raises; any other came from outside and says nothing about the file.
_CRASHES = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP, signal.SIGSYS})


class ParserFailedError(Exception):
    """The child crashed on the request; the message says how ("was ended by SIGSEGV")."""


class ParserKilledError(Exception):
    """The child was killed from outside or took too long, which need not be the file's fault; the message says which."""

    def __init__(self, message: str, timed_out: bool = False) -> None:
        super().__init__(message)
        self.timed_out = timed_out


class ParserProcess:
    """A child that runs `module` and answers requests (JSON lines through `serve`), started at the first request and after a crash."""

    def __init__(self, module: str, variables: Mapping[str, str] | None = None) -> None:
        self._command = python_command("-m", module, str(os.getpid()))
        self._environment = python_environment(variables)
        self._child: subprocess.Popen[bytes] | None = None
        self._answers = -1  # read end of a pipe of its own: libraries may print to stdout

    def ask(self, request: Mapping[str, Any], seconds: float) -> dict[str, Any]:
        """The child's answer. Raises ParserFailedError when it crashes, ParserKilledError when it is killed or takes over `seconds`."""
        child = self._running()
        assert child.stdin is not None
        line = b""
        try:
            child.stdin.write(json.dumps(request).encode() + b"\n")
            child.stdin.flush()
            line = self._answer(time.monotonic() + seconds)
        except BrokenPipeError:
            pass
        if not line.endswith(b"\n"):
            raise self._ended(seconds)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> ParserProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the child."""
        if self._child is not None:
            self._child.kill()
            self._child.communicate()
            os.close(self._answers)
            self._child = None

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is None:
            self._answers, write = os.pipe()
            self._child = subprocess.Popen(
                [*self._command, str(write)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, env=self._environment, pass_fds=(write,)
            )
            os.close(write)
        return self._child

    def _answer(self, deadline: float) -> bytes:
        """The next line of the child; an incomplete one when it ends or the deadline passes."""
        line = b""
        with selectors.DefaultSelector() as selector:
            selector.register(self._answers, selectors.EVENT_READ)
            while not line.endswith(b"\n") and selector.select(max(0.0, deadline - time.monotonic())):
                chunk = os.read(self._answers, 1 << 16)
                if not chunk:
                    break
                line += chunk
        return line

    def _ended(self, seconds: float) -> ParserFailedError | ParserKilledError:
        """The error of a child that did not answer; it is gone afterwards."""
        assert self._child is not None
        try:
            code = self._child.wait(timeout=1.0)  # it has closed its pipe, unless it runs still
        except subprocess.TimeoutExpired:
            return ParserKilledError(f"took longer than {seconds:.0f} s", timed_out=True)
        finally:
            self.close()
        if code < 0 and -code in _CRASHES:
            return ParserFailedError(f"was ended by {signal.Signals(-code).name}")
        return ParserKilledError(f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}")


def serve(answer: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Main of a `ParserProcess` (`… PARENT HANDLE`): answer the requests on stdin until it closes, or until the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle; it ends its children
    exit_with_parent(int(sys.argv[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with os.fdopen(int(sys.argv[2]), "wb") as sink:
        for line in sys.stdin.buffer:
            sink.write(json.dumps(answer(json.loads(line))).encode() + b"\n")
            sink.flush()


def exit_with_parent(parent: int) -> None:
    """End this process when its parent ends, so that a killed run leaves no process behind."""

    def poll() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(75)

    threading.Thread(target=poll, daemon=True).start()


def limit_memory(memory: int) -> None:
    """Limit this process's address space to `memory` bytes beyond what it has mapped; a later call replaces the limit."""
    with open("/proc/self/statm", encoding="ascii") as file:
        mapped = int(file.read().split()[0]) * resource.getpagesize()
    highest = resource.getrlimit(resource.RLIMIT_AS)[1]
    limit = mapped + memory if highest == resource.RLIM_INFINITY else min(mapped + memory, highest)
    resource.setrlimit(resource.RLIMIT_AS, (limit, highest))
