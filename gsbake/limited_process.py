"""Python children that parse untrusted files: with a limit on memory and time, so that a hostile file costs a sentence, not the machine.

A parser in native code may loop, exhaust memory or crash. In a child, each of these is an exit status. A `ParserProcess` answers requests
about files, one at a time, and is started again after a crash; its main is `serve`.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, BinaryIO

from gsbake.errors import BadInputError, InterruptedRun
from gsbake.memory_budget import budget, too_large
from gsbake.python_process import python_command, python_environment
from gsbake.system.exit_codes import ExitCode
from gsbake.system.limits import limit_address_space, write_no_core
from gsbake.system.pipes import LineReader, take_standard_streams
from gsbake.system.processes import exit_with_parent, resident_memory

_COMMAND = "from gsbake.limited_process import child; child()"
#: Seconds between looks at the memory of a child that cannot limit it itself.
_MEMORY_POLL = 0.05
#: Start of the line in which a child asks to be watched; answers are JSON objects.
_WATCH = b"memory "
#: The child's ends of the pipes, once it has taken them.
_streams: list[BinaryIO] = []


class ParserFailedError(Exception):
    """The child crashed on the request; the message says how ("was ended by SIGSEGV")."""


class ParserKilledError(Exception):
    """The child was killed from outside or took too long, which need not be the file's fault; the message says which."""

    def __init__(self, message: str, timed_out: bool = False) -> None:
        super().__init__(message)
        self.timed_out = timed_out


class ParserProcess:
    """A child that runs `main()` of `module` and answers requests (JSON lines, see `serve`), started at the first one and after a crash."""

    def __init__(self, module: str, variables: Mapping[str, str] | None = None) -> None:
        self._command = python_command("-c", _COMMAND, module, str(os.getpid()))
        self._environment = python_environment(variables)
        self._child: subprocess.Popen[bytes] | None = None
        self._answers: LineReader | None = None

    def ask(self, request: Mapping[str, Any], seconds: float) -> dict[str, Any]:
        """The child's answer. Raises ParserFailedError when it crashes, ParserKilledError when it is killed or takes over `seconds`."""
        child = self._running()
        assert child.stdin is not None
        line = None
        try:
            child.stdin.write(json.dumps(request).encode() + b"\n")
            child.stdin.flush()
            line = self._answer(time.monotonic() + seconds)
        except OSError:  # it has ended; Windows has other words for that than BrokenPipeError
            pass
        if line is None:
            raise self._ended(seconds)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> ParserProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the child."""
        if self._child is None or self._answers is None:
            return
        self._child.kill()
        self._child.wait()
        self._answers.close()
        if self._child.stdin is not None:
            with suppress(OSError):  # what it has not read
                self._child.stdin.close()
        self._child = self._answers = None

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is None:
            self._child = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=self._environment)
            assert self._child.stdout is not None
            self._answers = LineReader(self._child.stdout)
        return self._child

    def _answer(self, deadline: float) -> bytes | None:
        """The next line of the child; None when it ends or the deadline passes.

        Raises ParserFailedError when it takes more memory than its limit, where it has asked for one that the system does not keep.
        """
        assert self._answers is not None and self._child is not None
        limit: int | None = None
        while not self._answers.ended and (left := deadline - time.monotonic()) > 0:
            line = self._answers.line(left if limit is None else min(left, _MEMORY_POLL))
            if line is not None and not line.startswith(_WATCH):
                return line
            if line is not None:
                limit = int(line.removeprefix(_WATCH)) + resident_memory(self._child.pid)
            elif limit is not None and resident_memory(self._child.pid) > limit:
                self.close()
                raise ParserFailedError("took more memory than it may")
        return None

    def _ended(self, seconds: float) -> ParserFailedError | ParserKilledError:
        """The error of a child that did not answer; it is gone afterwards."""
        assert self._child is not None
        try:
            code = self._child.wait(timeout=1.0)  # it has closed its pipe, unless it runs still
        except subprocess.TimeoutExpired:
            return ParserKilledError(f"took longer than {seconds:.0f} s", timed_out=True)
        finally:
            self.close()
        found = ExitCode.of(code)
        if found.crashed:
            return ParserFailedError(f"was ended by {found}")
        return ParserKilledError(f"was ended by {found}" if found.signal else f"ended with {found}")


def read_in_child(child: ParserProcess, request: Mapping[str, Any], seconds: float, name: str) -> dict[str, Any]:
    """The child's answer about the file `name`.

    Raises BadInputError, which names it, for {"error": sentence}, for {"needs": bytes} that are too many, and for a child that crashes,
    takes more memory than it may, or more time; InterruptedRun for one that is killed from outside.
    """
    try:
        found = child.ask(request, seconds)
    except ParserKilledError as error:
        if not error.timed_out:
            raise InterruptedRun(f"The process that read {name} {error}; run the same command again.") from error
        raise BadInputError(f"{name} cannot be read (its reader {error}).") from error
    except ParserFailedError as error:
        raise BadInputError(f"{name} cannot be read (its reader {error}).") from error
    if "needs" in found:
        raise too_large(int(found["needs"]), budget(), name)
    if "exhausted" in found:
        raise BadInputError(f"{name} takes more memory than its header explains; export it again.")
    if "error" in found:
        raise BadInputError(found["error"])
    return found


def child() -> None:
    """Entry point of a `ParserProcess` (`python -c … MODULE PARENT`): `main()` of the module, whose imports may print what they like."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle; it ends its children
    exit_with_parent(int(sys.argv[2]), InterruptedRun.exit_code)
    write_no_core()
    _streams[:] = take_standard_streams(quiet=True)
    importlib.import_module(sys.argv[1]).main()


def serve(answer: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Answer the parent's requests until it closes the pipe."""
    requests, _ = _streams
    for line in requests:
        try:
            found = answer(json.loads(line))
        except MemoryError:  # its limit, which the parent set: the file is at fault
            found = {"exhausted": True}
        _send(json.dumps(found).encode())


def limit_memory(memory: int) -> None:
    """Limit this process to `memory` bytes beyond what it has now; a later call replaces the limit.

    Where the system keeps no such limit, the parent watches the process, and ends it.
    """
    if not limit_address_space(memory):
        _send(_WATCH + str(memory).encode())


def _send(line: bytes) -> None:
    _, answers = _streams
    answers.write(line + b"\n")
    answers.flush()
