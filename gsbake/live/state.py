"""What the live view shows, collected from the events of a run; all methods may be called from several threads."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from gsbake.pipeline.engine import Observer
from gsbake.pipeline.lease import LeaseHolder
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.stage import Stage
from gsbake.text import duration, printable
from gsbake.timing.estimate import Estimate
from gsbake.timing.time_left import TimeLeft

#: Points of a curve: every second is left out when there are more.
MAX_POINTS = 600
#: Most decisions and warnings that are kept.
MAX_LINES = 500


class LiveState(Observer):
    """The run so far as JSON, and the events passed on to another observer. `expected` estimates a stage that starts."""

    expected: Callable[[StageState], Estimate | None] = staticmethod(lambda state: None)

    def __init__(self, display: Observer) -> None:
        self.display = display
        self._lock = threading.Lock()
        self._left: tuple[str, TimeLeft] | None = None  # the running stage
        self._begin = time.monotonic()
        self._stages: list[dict[str, Any]] = []
        self._curves: dict[str, list[tuple[float, float]]] = {}
        self._lines: list[dict[str, str]] = []
        self._ended = False

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON."""
        with self._lock:
            now = time.monotonic()
            running, left = ("", "") if self._left is None else (self._left[0], self._left[1].text(now))
            return {
                "seconds": round(now - self._begin, 1),
                "stages": [stage | ({"left": left} if stage["name"] == running else {}) for stage in self._stages],
                "curves": {name: list(points) for name, points in self._curves.items()},
                "lines": list(self._lines),
                "ended": self._ended,
            }

    def end(self) -> None:
        """The run is over."""
        with self._lock:
            self._ended = True

    # -- events ---------------------------------------------------------------------------------------------------------------------

    def run_started(self, stages: list[Stage]) -> None:
        """List the stages."""
        with self._lock:
            self._begin = time.monotonic()
            self._stages = [{"name": s.name, "title": printable(s.title), "status": "waiting"} for s in stages]
        self.display.run_started(stages)

    def stage_reused(self, state: StageState) -> None:
        """Mark a stage as done."""
        self._set(state.name, status="cached")
        self.display.stage_reused(state)

    def stage_started(self, state: StageState) -> None:
        """Mark a stage as running."""
        with self._lock:
            self._left = state.name, TimeLeft(time.monotonic(), self.expected(state))
            self._curves = {}
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
                points = self._curves.setdefault(printable(key), [])
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

    def _add(self, kind: str, stage: str, text: str) -> None:
        with self._lock:
            self._lines.append({"kind": kind, "stage": stage, "text": printable(text)})
            del self._lines[:-MAX_LINES]
