"""Supervision of a stage's worker process: messages, peak memory, stop signals and exit status."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import psutil

from gsbake import errors
from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.pipeline.machine import thread_environment
from gsbake.pipeline.worker import STOP_REQUEST, Job
from gsbake.python_process import python_command, python_environment
from gsbake.system import processes
from gsbake.system.exit_codes import ExitCode
from gsbake.system.pipes import LineReader

#: Seconds for a stage to acknowledge a stop request, and then to write its checkpoint.
STOP_TIMEOUT = 5.0
CHECKPOINT_TIMEOUT = 30.0

#: Seconds between samples of the memory of the worker and its child processes.
_MEMORY_SAMPLE_INTERVAL = 0.5
#: Seconds for the last messages of a worker that has ended to arrive.
_LAST_WORDS = 2.0
_COMMAND = "from gsbake.pipeline.worker import main; main()"
_STOPPED = "Stopped on request; the same command resumes the run."


class StageFailed(GsbakeError):
    """Internal error in a stage; `details` holds the traceback."""

    def __init__(self, message: str, details: str = "") -> None:
        super().__init__(message)
        self.details = details


class StopSignals:
    """Context that counts the signals of a stop request instead of their default action; has no effect outside the main thread."""

    def __init__(self) -> None:
        self.count = 0
        self._old: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            self._old = processes.set_handlers(self._on_signal)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.count += 1

    def check(self) -> None:
        """Raise InterruptedRun if a stop was requested."""
        if self.count:
            raise InterruptedRun(_STOPPED)


@dataclass
class Outcome:
    """Report of a finished stage: results, seconds of its parts, decisions, warnings, run time and peak memory."""

    results: dict[str, Any] = field(default_factory=dict)
    parts: dict[str, float] = field(default_factory=dict)
    decisions: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    peak_bytes: int = 0


class Worker:
    """A worker process and the pipes to it."""

    def __init__(self, job: Job, log: Path) -> None:
        with log.open("wb") as sink:
            self.process = processes.start_apart(
                python_command("-c", _COMMAND), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=sink,
                env=python_environment(thread_environment(job.threads)),
            )  # fmt: skip
        assert self.process.stdout is not None
        self._reader = LineReader(self.process.stdout)
        self._send(job.dumps().encode() + b"\n")
        self.peak = 0
        self._sampled = -_MEMORY_SAMPLE_INTERVAL

    def messages(self, timeout: float) -> tuple[list[dict[str, Any]], bool]:
        """Messages received within `timeout` seconds, and whether the worker has ended."""
        ended = self.process.poll() is not None
        lines = self._reader.last_lines(_LAST_WORDS) if ended else self._reader.lines(timeout)
        if self._reader.ended:
            self.process.wait()
        return [json.loads(line) for line in lines], self._reader.ended

    def sample_memory(self) -> None:
        """Update the peak memory of the worker and its child processes."""
        now = time.monotonic()
        if now - self._sampled < _MEMORY_SAMPLE_INTERVAL:
            return
        self._sampled = now
        self.peak = max(self.peak, processes.resident_memory(self.process.pid))

    def request_stop(self) -> None:
        """Request the stage to stop."""
        self._send(STOP_REQUEST)

    def kill(self) -> None:
        """Kill the worker and its child processes."""
        processes.kill(self.process)

    def close(self) -> None:
        """Kill the worker if it still runs, and close the pipes."""
        if self.process.poll() is None:
            self.kill()
        self._reader.close()
        assert self.process.stdin is not None
        with suppress(OSError):  # what it has not read
            self.process.stdin.close()

    def _send(self, line: bytes) -> None:
        assert self.process.stdin is not None
        with suppress(OSError):  # it has ended
            self.process.stdin.write(line)
            self.process.stdin.flush()


def supervise(
    job: Job, log: Path, stop: StopSignals, on_message: Callable[[dict[str, Any]], None], *, stop_timeout: float = STOP_TIMEOUT
) -> Outcome:
    """Run a job in a worker process and return its report. Raises the errors that the stage raised.

    A stop request is sent to the stage. The worker is killed at a second signal, or when it has not acknowledged within `stop_timeout`
    seconds.
    """
    outcome = Outcome()
    start = time.perf_counter()
    last: dict[str, Any] = {}
    worker = Worker(job, log)
    deadline = None
    try:
        ended = False
        while not ended:
            messages, ended = worker.messages(0.1)
            for message in messages:
                match message["kind"]:
                    case "done" | "failed":
                        last = message
                    case "decision":
                        outcome.decisions.append({k: v for k, v in message.items() if k != "kind"})
                    case "warning":
                        outcome.warnings.append(message["text"])
                    case "stopping":
                        deadline = time.monotonic() + max(stop_timeout, CHECKPOINT_TIMEOUT)
                on_message(message)
            worker.sample_memory()
            if stop.count and deadline is None:
                deadline = time.monotonic() + stop_timeout
                worker.request_stop()
                on_message({"kind": "stop sent"})
            if not last and (stop.count > 1 or (deadline is not None and time.monotonic() > deadline)):
                worker.kill()
                raise InterruptedRun("Killed on request; the same command resumes from the last checkpoint.")
        if not last:
            raise _unexpected_exit(worker, log, stop)
    finally:
        worker.close()
    outcome.seconds = time.perf_counter() - start
    if last["kind"] == "failed":
        raise _reported_error(last, worker.peak)
    outcome.results, outcome.parts = last["results"], last["parts"]
    outcome.peak_bytes = max(worker.peak, last["peak"])
    return outcome


def _reported_error(message: dict[str, Any], peak: int) -> GsbakeError:
    """The exception that a failed worker reported."""
    kind = message["error"]
    if kind == "MemoryError":
        return _out_of_memory(f"{message['message']}; {peak / 1e9:.1f} GB in use")
    if kind == "InterruptedRun":
        return InterruptedRun(_STOPPED if message["message"].startswith("Stopped on request") else message["message"])
    if kind == "unexpected":
        return StageFailed(message["message"], message["traceback"])
    error: GsbakeError = getattr(errors, kind)(message["message"])
    return error


def _out_of_memory(evidence: str) -> InterruptedRun:
    """One error for a failed allocation and for a kill by the kernel: both depend on what else runs on the machine."""
    return InterruptedRun(
        f"Out of memory ({evidence}): close other programs and run the same command, which resumes; or use a smaller profile, or reduce "
        "ingest.max_size, train.max_size or bake.size."
    )


def _unexpected_exit(worker: Worker, log: Path, stop: StopSignals) -> GsbakeError:
    """The error of a worker that ended without reporting a result."""
    code = ExitCode.of(worker.process.returncode)
    if stop.count:
        return InterruptedRun(_STOPPED)
    if code.requested:  # before the worker handled it: it was just starting
        return InterruptedRun(f"The stage's process was ended from outside by {code}; the same command resumes the run.")
    with suppress(OSError):
        tail = log.read_text(encoding="utf-8", errors="replace")[-4000:]
        if code.killed:
            total = psutil.virtual_memory().total
            return _out_of_memory(f"killed by the system at {worker.peak / 1e9:.1f} GB of {total / 1e9:.1f} GB")
        return StageFailed(f"the stage's process ended with {code}", tail)
    return StageFailed(f"the stage's process ended with {code}")
