"""What a run shows: bars with remaining time and live figures on a terminal, timed lines elsewhere, warnings only when quiet."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

from gsbake.pipeline.engine import Observer
from gsbake.pipeline.lease import Holder
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.stage import Stage
from gsbake.text import duration, figures, number, size

#: Seconds between progress lines where there is no terminal.
LINE_EVERY = 10.0


class QuietDisplay(Observer):
    """Warnings on stderr, nothing else."""

    def __init__(self) -> None:
        self.errors = Console(stderr=True, highlight=False, soft_wrap=True)

    def warned(self, name: str, text: str) -> None:
        """Show a warning."""
        self.errors.print(f"gsbake: warning ({name}): {text}", markup=False)


class PlainDisplay(QuietDisplay):
    """Timed lines, for logs and pipes."""

    def __init__(self, console: Console | None = None) -> None:
        super().__init__()
        self.console = console or Console(highlight=False, soft_wrap=True)
        self._begin = time.monotonic()
        self._stage_begin = self._begin
        self._last = self._begin
        self._waiting = ""

    def say(self, text: str) -> None:
        """Print a line with the time since the run began."""
        self.console.print(f"{_clock(time.monotonic() - self._begin)}  {text}", markup=False)

    def begins(self, stages: list[Stage]) -> None:
        """Start the clock."""
        self._begin = time.monotonic()

    def served(self, state: StageState) -> None:
        """Show a stage that needs no work."""
        self.say(f"{state.name}: {'replaced by hand' if state.status == 'replaced' else 'cached'}")

    def starts(self, state: StageState) -> None:
        """Show why a stage runs."""
        self._stage_begin = self._last = time.monotonic()
        self.say(f"{state.name}: {state.title} ({'; '.join(state.reasons)})")

    def waits(self, name: str, holder: Holder | None) -> None:
        """Say once who holds the lease."""
        text = f"{name}: waiting, {holder or 'another process'} is computing it"
        if text != self._waiting:
            self._waiting = text
            self.say(text)

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """A line every now and then."""
        now = time.monotonic()
        if now - self._last < LINE_EVERY:
            return
        self._last = now
        left = (now - self._stage_begin) / done * (total - done) if done else None
        parts = [f"{name}: {done}/{total}", text, _live(live), f"about {duration(left)} left" if left is not None else ""]
        self.say(", ".join(part for part in parts if part))

    def decided(self, name: str, what: str, choice: str, evidence: str) -> None:
        """Show a decision."""
        self.say(f"{name}: {what}: {choice} ({evidence})")

    def stopping(self, name: str) -> None:
        """Say that the stop was heard."""
        self.say(f"{name}: stopping; once more stops at once")

    def finished(self, state: StageState) -> None:
        """Show what a stage took and found."""
        self.say(f"{state.name}: {_summary(state)}")


class TerminalDisplay(PlainDisplay):
    """Bars with remaining time and live figures."""

    def __init__(self) -> None:
        super().__init__()
        columns = (TextColumn("{task.description:>8}"), BarColumn(32), TaskProgressColumn(), TimeRemainingColumn())
        note = TextColumn("{task.fields[note]}")
        self._bar = Progress(*columns, note, console=self.console, transient=True, refresh_per_second=5)
        self._task: TaskID | None = None

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(text, markup=False)

    def served(self, state: StageState) -> None:
        """Show a stage that needs no work."""
        self.console.print(f"[green]✓[/] {state.name:<7} [dim]{'replaced by hand' if state.status == 'replaced' else 'cached'}[/]")

    def starts(self, state: StageState) -> None:
        """Open the stage's bar."""
        self._stage_begin = time.monotonic()
        self._task = self._bar.add_task(state.name, total=None, note=state.title)
        self._bar.start()

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """Move the bar."""
        if self._task is not None:
            note = " ".join(part for part in (text, _live(live)) if part)
            self._bar.update(self._task, completed=done, total=total or None, note=note)

    def decided(self, name: str, what: str, choice: str, evidence: str) -> None:
        """Show a decision."""
        self.say(f"  {what}: {choice} ({evidence})")

    def warned(self, name: str, text: str) -> None:
        """Show a warning above the bar."""
        self.errors.print(f"gsbake: warning ({name}): {text}", markup=False)

    def finished(self, state: StageState) -> None:
        """Replace the bar by what the stage took and found."""
        self.close()
        self.console.print(f"[green]✓[/] {state.name:<7} {_summary(state)}")

    def close(self) -> None:
        """Take the bar away, whatever ended the run."""
        if self._task is not None:
            self._bar.remove_task(self._task)
            self._task = None
        self._bar.stop()


def choose_display(*, quiet: bool, as_json: bool) -> QuietDisplay:
    """The display that fits where the output goes."""
    if quiet or as_json:
        return QuietDisplay()
    return TerminalDisplay() if Console().is_terminal else PlainDisplay()


def close_display(display: Observer) -> None:
    """Leave the terminal as it was."""
    if isinstance(display, TerminalDisplay):
        display.close()


def _summary(state: StageState) -> str:
    manifest: Mapping[str, Any] = state.artifact.manifest if state.artifact is not None else {}
    parts = [duration(manifest.get("seconds", 0.0)), size(manifest.get("peak_bytes", 0)), figures(manifest.get("results", {}))]
    return ", ".join(part for part in parts if part)


def _live(live: Mapping[str, float]) -> str:
    return " ".join(f"{name} {number(value)}" for name, value in live.items())


def _clock(seconds: float) -> str:
    whole = int(seconds)
    return f"{whole // 3600:d}:{whole // 60 % 60:02d}:{whole % 60:02d}"
