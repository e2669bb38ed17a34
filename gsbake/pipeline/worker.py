"""The process a stage runs in: it reads a job from stdin, runs the stage, and reports in JSON lines on a pipe.

Each stage has a process of its own. So thread pools are sized before any library loads, one stage's libraries cannot upset the
next's, peak memory is the stage's own, memory goes back to the system, and a crash or a kill by the system inside a native
library becomes a sentence instead of the end of the run. The process dies with the one that started it: no orphan goes on
writing.
"""

from __future__ import annotations

import contextlib
import ctypes
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
from typing import Any

from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.pipeline.files import disk_error
from gsbake.pipeline.machine import peak_memory
from gsbake.pipeline.registry import load_stage
from gsbake.pipeline.settings import SettingsView

#: Progress is reported at most this often (seconds).
PROGRESS_EVERY = 0.1

_OUT_OF_MEMORY = re.compile(r"can't allocate memory|out of memory|insufficient memory|bad_alloc|unable to allocate", re.IGNORECASE)


@dataclass(frozen=True)
class Job:
    """What a worker is told: everything a stage's context holds, as JSON."""

    stage: str  # "module:attribute"
    out: str
    inputs: Mapping[str, str]
    schema: str  # "module:class" of the profile
    profile: Mapping[str, Any]
    seed: int
    threads: int
    device: str
    checkpoint: str
    place: str  # the person's output folder, for messages
    parent: int  # process id of the supervisor

    def dumps(self) -> str:
        """The job as JSON."""
        return json.dumps(asdict(self))

    @staticmethod
    def loads(text: str) -> Job:
        """Read what `dumps` wrote."""
        return Job(**json.loads(text))


class Line:
    """The pipe to the supervisor; when it is gone, so is the reason to go on."""

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._lock = threading.Lock()

    def send(self, kind: str, **fields: Any) -> None:
        """Send one message."""
        data = (json.dumps(plain({"kind": kind, **fields})) + "\n").encode()
        with self._lock:
            try:
                while data:
                    data = data[os.write(self._handle, data) :]
            except BrokenPipeError:
                os._exit(InterruptedRun.exit_code)


class WorkerContext:
    """The Context of a stage that runs in this process."""

    def __init__(self, job: Job, settings: Any, line: Line) -> None:
        self.out = Path(job.out)
        self.inputs: Mapping[str, Path] = {name: Path(path) for name, path in job.inputs.items()}
        self.settings = settings
        self.seed = job.seed
        self.threads = job.threads
        self.device = job.device
        self.checkpoint = Path(job.checkpoint)
        self.parts: dict[str, float] = {}
        self._line = line
        self._stop = threading.Event()
        self._polls = False
        self._acknowledged = False
        self._last = -math.inf

    def request_stop(self, *_: object) -> None:
        """Handler of SIGTERM."""
        self._stop.set()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Time a part of the stage; parts of one name add up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.parts[name] = self.parts.get(name, 0.0) + time.perf_counter() - start

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Report progress; a stage that never polls `stop_requested` is interrupted here."""
        if not self._polls:
            self.check_stop()
        now = time.monotonic()
        if now - self._last >= PROGRESS_EVERY or done >= total:
            self._last = now
            self._line.send("progress", done=done, total=total, text=text, live=live)

    def stop_requested(self) -> bool:
        """Whether to write a checkpoint and stop."""
        self._polls = True
        if self._stop.is_set() and not self._acknowledged:
            self._acknowledged = True
            self._line.send("stopping")
        return self._stop.is_set()

    def check_stop(self) -> None:
        """Raise InterruptedRun if a stop was requested."""
        if self._stop.is_set():
            raise InterruptedRun("Stopped on request.")

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Log a decision."""
        more = {} if saved is None else {"saved_s": round(saved, 1)}
        self._line.send("decision", what=what, choice=choice, evidence=evidence, **more)

    def warn(self, text: str) -> None:
        """Warn the person."""
        self._line.send("warning", text=text)


def plain(value: Any) -> Any:
    """`value` as strict JSON takes it: numpy scalars and arrays become numbers and lists, paths strings, NaN and infinity null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    raise TypeError(f"a stage reported a {type(value).__name__}, which JSON cannot hold")


def die_with_parent(parent: int) -> None:
    """Let the kernel kill this process when its supervisor dies; where it cannot, watch for it."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os._exit(InterruptedRun.exit_code)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(InterruptedRun.exit_code)

    if sys.platform != "linux":
        threading.Thread(target=watch, name="parent watch", daemon=True).start()


def run_job(job: Job, line: Line) -> None:
    """Run the stage and report how it ended."""
    import importlib

    try:
        stage = load_stage(job.stage)
        module, _, name = job.schema.partition(":")
        profile = getattr(importlib.import_module(module), name).model_validate(job.profile)
        context = WorkerContext(job, SettingsView(profile, stage.settings, stage.name), line)
        signal.signal(signal.SIGTERM, context.request_stop)
        line.send("ready")
        results = plain(stage.run(context) or {})
        line.send("done", results=results, parts=context.parts, peak=peak_memory())
    except GsbakeError as error:
        line.send("failed", error=_public_name(error), message=str(error), traceback=traceback.format_exc())
    except BaseException as error:
        memory = isinstance(error, MemoryError) or _OUT_OF_MEMORY.search(str(error)) is not None
        disk = disk_error(error, Path(job.place))
        name = "MemoryError" if memory else "BadInputError" if disk else "unexpected"
        message = str(disk) if disk and not memory else one_line(f"{type(error).__name__}: {error}")
        line.send("failed", error=name, message=message, traceback=traceback.format_exc())


def one_line(text: str, limit: int = 300) -> str:
    """`text` without line breaks, cut to `limit` characters."""
    flat = " ".join(text.split())
    return flat if len(flat) <= limit else f"{flat[: limit - 1]}…"


def _public_name(error: GsbakeError) -> str:
    """The class of errors.py that `error` is or derives from, so that the supervisor can raise it again."""
    return next(c.__name__ for c in type(error).__mro__ if c.__module__ == GsbakeError.__module__)


def main() -> None:
    """Entry of the worker process: `python -c … HANDLE` with the job on stdin."""
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    handle = int(sys.argv[1])
    os.set_inheritable(handle, False)
    job = Job.loads(sys.stdin.read())
    die_with_parent(job.parent)
    run_job(job, Line(handle))
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(0)  # skips the tear-down of native libraries, whose crashes at exit would spoil a finished stage
