"""Worker process: reads a job and stop requests from its parent, runs the job's stage and reports in JSON Lines.

Each stage runs in its own process. So thread pools are sized before libraries load, libraries of different stages do not interfere, peak
memory is measured per stage and returned to the system, and a crash or kill inside a native library becomes an error message. The process
ends with its parent, so no orphan keeps writing.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import math
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.pipeline.files import disk_error
from gsbake.pipeline.registry import load_stage
from gsbake.pipeline.settings import SettingsView
from gsbake.system.limits import peak_memory
from gsbake.system.pipes import take_standard_streams
from gsbake.system.processes import exit_with_parent, kill_with_parent
from gsbake.text import printable

#: Minimum time between progress messages in seconds.
PROGRESS_INTERVAL = 0.1
#: The line after the job by which the supervisor asks the stage to stop. Signals would not do: on Windows they only kill.
STOP_REQUEST = b"stop\n"

#: Messages of libraries that report a failed allocation in their own exception types.
_OUT_OF_MEMORY = re.compile(r"can't allocate memory|out of memory|insufficient memory|bad_alloc|unable to allocate", re.IGNORECASE)


@dataclass(frozen=True)
class Job:
    """Job of a worker: the content of the stage's context, JSON-serialisable."""

    stage: str  # "module:attribute"
    out: str
    inputs: Mapping[str, str]
    schema: str  # "module:class" of the profile
    profile: Mapping[str, Any]
    seed: int
    threads: int
    device: str
    checkpoint: str
    cache: str
    output_folder: str  # the user's output folder, for messages
    parent: int  # process id of the supervisor

    def dumps(self) -> str:
        """The job as JSON."""
        return json.dumps(asdict(self))

    @staticmethod
    def loads(text: str) -> Job:
        """Parse the output of `dumps`."""
        return Job(**json.loads(text))


class MessagePipe:
    """Write end of the pipe to the supervisor; the process exits when the read end is closed."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()

    def send(self, kind: str, **fields: Any) -> None:
        """Send one message."""
        data = (json.dumps(to_json({"kind": kind, **fields})) + "\n").encode()
        with self._lock:
            try:
                self._stream.write(data)
                self._stream.flush()
            except OSError:  # Windows has other words for it than BrokenPipeError
                os._exit(InterruptedRun.exit_code)


class WorkerContext:
    """Context of the stage that runs in this process."""

    def __init__(self, job: Job, settings: Any, pipe: MessagePipe) -> None:
        self.out = Path(job.out)
        self.inputs: Mapping[str, Path] = {name: Path(path) for name, path in job.inputs.items()}
        self.settings = settings
        self.seed = job.seed
        self.threads = job.threads
        self.device = job.device
        self.checkpoint = Path(job.checkpoint)
        self.cache = Path(job.cache)
        self.parts: dict[str, float] = {}
        self._pipe = pipe
        self._stop = threading.Event()
        self._polls_stop = False
        self._acknowledged = False
        self._last = -math.inf

    def request_stop(self, *_: object) -> None:
        """Ask the stage to stop, for the supervisor or, as the handler of SIGTERM, for a scheduler that signals all processes of a job."""
        self._stop.set()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Measure the time of a part of the stage, and report its start; times of parts with the same name are added."""
        self._pipe.send("part", name=name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.parts[name] = self.parts.get(name, 0.0) + time.perf_counter() - start

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Report progress. Raises InterruptedRun on a stop request if the stage does not poll `stop_requested`."""
        if not self._polls_stop:
            self.check_stop()
        now = time.monotonic()
        if now - self._last >= PROGRESS_INTERVAL or done >= total:
            self._last = now
            self._pipe.send("progress", done=done, total=total, text=printable(text), live=live)

    def stop_requested(self) -> bool:
        """Whether to write a checkpoint and stop."""
        self._polls_stop = True
        if self._stop.is_set() and not self._acknowledged:
            self._acknowledged = True
            self._pipe.send("stopping")
        return self._stop.is_set()

    def check_stop(self) -> None:
        """Raise InterruptedRun if a stop was requested."""
        if self._stop.is_set():
            raise InterruptedRun("Stopped on request.")

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Report a decision; `saved` is the saved time in seconds."""
        saved_time = {} if saved is None else {"saved_s": round(saved, 1)}
        self._pipe.send("decision", what=printable(what), choice=printable(choice), evidence=printable(evidence), **saved_time)

    def warn(self, text: str) -> None:
        """Report a warning for the user."""
        self._pipe.send("warning", text=printable(text))


def to_json(value: Any) -> Any:
    """`value` in strict JSON types: numpy scalars and arrays become numbers and lists, paths strings, NaN and infinity null.

    Raises TypeError for other types.
    """
    if isinstance(value, Mapping):
        return {str(k): to_json(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_json(v) for v in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return to_json(value.tolist())
    raise TypeError(f"a stage reported a {type(value).__name__}, which is not JSON-serialisable")


class StopRequests:
    """Reads the supervisor's requests to stop. Before the stage runs there is nothing to save: the process exits."""

    def __init__(self, requests: BinaryIO) -> None:
        self._requests = requests
        self.context: WorkerContext | None = None
        threading.Thread(target=self._read, name="stop requests", daemon=True).start()

    def _read(self) -> None:
        for line in self._requests:
            if line == STOP_REQUEST and self.context is None:
                os._exit(InterruptedRun.exit_code)
            elif line == STOP_REQUEST and self.context is not None:
                self.context.request_stop()


def run_job(job: Job, pipe: MessagePipe, stop: StopRequests) -> None:
    """Run the stage of a job and report its results or its error."""
    import importlib

    try:
        stage = load_stage(job.stage)
        module, _, name = job.schema.partition(":")
        profile = getattr(importlib.import_module(module), name).model_validate(job.profile)
        context = WorkerContext(job, SettingsView(profile, stage.settings, stage.name), pipe)
        stop.context = context
        signal.signal(signal.SIGTERM, context.request_stop)
        pipe.send("ready")
        results = to_json(stage.run(context) or {})
        pipe.send("done", results=results, parts=context.parts, peak=peak_memory())
    except GsbakeError as error:
        pipe.send("failed", error=_public_name(error), message=str(error), traceback=traceback.format_exc())
    except BaseException as error:
        out_of_memory = isinstance(error, MemoryError) or _OUT_OF_MEMORY.search(str(error)) is not None
        disk = disk_error(error, Path(job.output_folder))
        name = "MemoryError" if out_of_memory else _public_name(disk) if disk else "unexpected"
        message = str(disk) if disk and not out_of_memory else one_line(f"{type(error).__name__}: {error}")
        pipe.send("failed", error=name, message=message, traceback=traceback.format_exc())


def one_line(text: str, limit: int = 300) -> str:
    """`text` printable and without line breaks, truncated to `limit` characters."""
    joined = printable(" ".join(text.split()))
    return joined if len(joined) <= limit else f"{joined[: limit - 1]}…"


def _public_name(error: GsbakeError) -> str:
    """Name of the class in `gsbake.errors` that `error` is an instance of, for the supervisor to raise again."""
    return next(c.__name__ for c in type(error).__mro__ if c.__module__ == GsbakeError.__module__)


def main() -> None:
    """Entry point of the worker process: `python -c …`, with the job as the first line on stdin."""
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, answers = take_standard_streams()
    job = Job.loads(requests.readline().decode())
    kill_with_parent()
    exit_with_parent(job.parent, InterruptedRun.exit_code)
    run_job(job, MessagePipe(answers), StopRequests(requests))
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(0)  # skip the tear-down of native libraries: a crash there would fail a finished stage
