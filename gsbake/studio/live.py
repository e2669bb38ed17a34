"""A run in progress, as OUT/live.json says: written by the run itself from its events, read by the studio and by `gsbake status`.

The file has stages, curves, decisions, warnings and the time left, and names the process. It is written at most once a second, and a last
time when the run ends, with its exit code and message; a run that was killed is one whose process is gone.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsbake.atomic import write_atomic
from gsbake.output_folder import LIVE
from gsbake.pipeline.engine import Observer
from gsbake.pipeline.lease import LeaseHolder
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.stage import Stage
from gsbake.text import duration, printable
from gsbake.timing.estimate import Estimate
from gsbake.timing.time_left import TimeLeft

#: Largest size in bytes of the file that is read.
MAX_BYTES = 4_000_000
#: Seconds between two writes.
INTERVAL = 1.0
#: Points of a curve: every second is left out when there are more.
MAX_POINTS = 600
#: Most decisions and warnings that are kept.
MAX_LINES = 500


@dataclass(frozen=True)
class LiveRun:
    """The last run of an output folder: its `holder` (process), whether that `runs`, and the file's contents as `document`."""

    holder: LeaseHolder | None
    runs: bool
    document: Mapping[str, Any]

    @staticmethod
    def read(out: Path) -> LiveRun | None:
        """The run that the output folder's file tells of; None without one."""
        path = out / LIVE
        with suppress(OSError, ValueError, RecursionError):
            if path.stat().st_size <= MAX_BYTES:
                document = json.loads(path.read_bytes())
                if isinstance(document, dict):
                    holder = LeaseHolder.read(path)
                    runs = not document.get("ended", True) and holder is not None and holder.alive() is not False
                    return LiveRun(holder, runs, document)
        return None

    @property
    def summary(self) -> str:
        """The running stage, how far it is, and the time left, in words."""
        stages = self.document.get("stages")
        for stage in stages if isinstance(stages, list) else []:
            if isinstance(stage, dict) and stage.get("status") == "running":
                steps = f"{stage.get('done')} of {stage.get('total')}" if stage.get("total") else ""
                return printable(", ".join(filter(None, (f"{stage.get('name')}", steps, str(stage.get("left") or "")))))
        return "between two stages"


class LiveState(Observer):
    """Writes the file from the events of a run, which it passes on to another observer. A context around the run; `expected` estimates a
    stage that starts."""

    expected: Callable[[StageState], Estimate | None] = staticmethod(lambda state: None)

    def __init__(self, display: Observer, out: Path) -> None:
        self.display, self.out = display, out
        self._holder = LeaseHolder.current()
        self._lock = threading.Lock()
        self._changed, self._stopped = threading.Event(), threading.Event()
        self._writer: threading.Thread | None = None  # from the start of the run, unless another run of the folder writes
        self._left: tuple[str, TimeLeft] | None = None  # the running stage
        self._begin = time.monotonic()
        self._stages: list[dict[str, Any]] = []
        self._curves: dict[str, list[tuple[float, float]]] = {}
        self._lines: list[dict[str, str]] = []
        self._end: dict[str, Any] = {"ended": False}

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON."""
        with self._lock:
            now = time.monotonic()
            running, left = ("", "") if self._left is None else (self._left[0], self._left[1].text(now))
            return {
                **asdict(self._holder),
                "seconds": round(now - self._begin, 1),
                "written": time.time(),
                "stages": [stage | ({"left": left} if stage["name"] == running else {}) for stage in self._stages],
                "curves": {name: list(points) for name, points in self._curves.items()},
                "lines": list(self._lines),
                **self._end,
            }

    def end(self, exit_code: int, message: str = "") -> None:
        """The run is over: write the file a last time."""
        with self._lock:
            self._end = {"ended": True, "exit_code": exit_code, "message": printable(message)}
        if self._writer is not None:
            self._stopped.set()
            self._changed.set()
            self._writer.join()
            self._write()

    def _start(self) -> None:
        """Write the file from now on, unless another run of this output folder does."""
        other = LiveRun.read(self.out)
        if self._writer is None and (other is None or not other.runs):
            self._write()
            self._writer = threading.Thread(target=self._keep_writing, name="live state", daemon=True)
            self._writer.start()

    def _keep_writing(self) -> None:
        while not self._stopped.is_set():
            self._changed.wait()
            self._changed.clear()
            self._write()
            self._stopped.wait(INTERVAL)

    def _write(self) -> None:
        with suppress(OSError):  # a full disk ends the run elsewhere, with a sentence
            write_atomic(self.out / LIVE, json.dumps(self.snapshot(), separators=(",", ":")))

    # -- events ---------------------------------------------------------------------------------------------------------------------

    def run_started(self, stages: list[Stage]) -> None:
        """List the stages."""
        with self._lock:
            self._begin = time.monotonic()
            self._stages = [{"name": s.name, "title": printable(s.title), "status": "waiting"} for s in stages]
        self._start()
        self.display.run_started(stages)

    def stage_reused(self, state: StageState) -> None:
        """Mark a stage as done."""
        self._set(state.name, status="cached")
        self.display.stage_reused(state)

    def stage_started(self, state: StageState) -> None:
        """Mark a stage as running."""
        with self._lock:
            self._left = state.name, TimeLeft(time.monotonic(), self.expected(state))
        self._set(state.name, status="running", done=0, total=0, text="")
        self.display.stage_started(state)

    def stage_waiting(self, name: str, holder: LeaseHolder | None) -> None:
        """Mark a stage that another process computes."""
        self._set(name, status="waiting", text="another process computes it")
        self.display.stage_waiting(name, holder)

    def part_started(self, name: str, part: str) -> None:
        """Update the time left."""
        with self._lock:
            if self._left is not None:
                self._left[1].start_part(time.monotonic(), part)
        self.display.part_started(name, part)

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """Update progress, time left and curves."""
        with self._lock:
            if self._left is not None:
                self._left[1].update(time.monotonic(), done, total)
            for key, value in live.items():
                points = self._curves.setdefault(printable(f"{name}: {key}"), [])
                points.append((float(done), float(value)))
                if len(points) > MAX_POINTS:
                    del points[1::2]
        self._set(name, done=done, total=total, text=printable(text))
        self.display.progress(name, done, total, text, live)

    def decision(self, name: str, what: str, choice: str, evidence: str) -> None:
        """Keep a decision."""
        self._add("decision", name, f"{what}: {choice} ({evidence})")
        self.display.decision(name, what, choice, evidence)

    def warning(self, name: str, text: str) -> None:
        """Keep a warning."""
        self._add("warning", name, text)
        self.display.warning(name, text)

    def stage_stopping(self, name: str) -> None:
        """Show that the stop was received."""
        self._set(name, text="stopping")
        self.display.stage_stopping(name)

    def stage_finished(self, state: StageState) -> None:
        """Mark a stage as done, with its summary and time."""
        manifest: Mapping[str, Any] = state.artifact.manifest if state.artifact is not None else {}
        text = printable(str(manifest.get("summary") or ""))
        with self._lock:
            self._left = None
        self._set(state.name, status="done", text=text, took=duration(float(manifest.get("seconds") or 0.0)))
        self.display.stage_finished(state)

    def _set(self, name: str, **fields: Any) -> None:
        with self._lock:
            for stage in self._stages:
                if stage["name"] == name:
                    stage.update(fields)
        self._changed.set()

    def _add(self, kind: str, stage: str, text: str) -> None:
        with self._lock:
            self._lines.append({"kind": kind, "stage": stage, "text": printable(text)})
            del self._lines[:-MAX_LINES]
        self._changed.set()
