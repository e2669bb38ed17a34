"""A monitor that records the reports of a step and can request a stop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from gsbake.errors import InterruptedRun


class Recorder:
    """`decisions` maps the subject of a decision to (choice, evidence); `stop_at` (text, done) interrupts at that progress."""

    def __init__(self, stop_at: tuple[str, int] | None = None) -> None:
        self.decisions: dict[str, tuple[str, str]] = {}
        self.saved: dict[str, float | None] = {}
        self.warnings: list[str] = []
        self.parts: dict[str, float] = {}
        self.progressed: list[tuple[int, int, str]] = []
        self._stop_at, self._stopping = stop_at, False

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.parts[name] = self.parts.get(name, 0.0) + time.perf_counter() - start

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        self.progressed.append((done, total, text))
        if self._stop_at is not None and text == self._stop_at[0] and done >= self._stop_at[1]:
            self._stopping = True
            self.check_stop()

    def stop_requested(self) -> bool:
        return self._stopping

    def check_stop(self) -> None:
        if self._stopping:
            raise InterruptedRun("Stopped on request.")

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        self.decisions[what] = (choice, evidence)
        self.saved[what] = saved

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def line(self, what: str) -> str:
        """A decision as one line: choice (evidence)."""
        choice, evidence = self.decisions[what]
        return f"{choice} ({evidence})"
