"""Console output of a run: progress bar and one line per stage on a terminal, timed lines elsewhere, decisions when verbose."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TaskProgressColumn, TextColumn
from rich.text import Text

from gsbake.cli.output import cell
from gsbake.pipeline.engine import Observer
from gsbake.pipeline.lease import LeaseHolder
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.stage import Stage
from gsbake.text import duration, figures, number, printable
from gsbake.timing.estimate import Estimate
from gsbake.timing.time_left import TimeLeft

#: Seconds between progress lines without a terminal.
PROGRESS_INTERVAL = 30.0
_PREPARED = "kernels: compiled"
_REUSED = {"cached": "cached", "replaced": "replaced by the user"}


class QuietDisplay(Observer):
    """Warnings on stderr, nothing else. `expected` estimates a stage that starts, for the displays that show the time left."""

    expected: Callable[[StageState], Estimate | None] = staticmethod(lambda state: None)

    def __init__(self) -> None:
        self.errors = Console(stderr=True, highlight=False, soft_wrap=True)

    def warning(self, name: str, text: str) -> None:
        """Print a warning."""
        self.errors.print(cell(f"gsbake: warning ({name}): {text}"))


    def preparing(self, done: int, total: int, text: str) -> None:
        """A stage waits for its kernels, of which `done` of `total` modules are compiled; `text` names it, empty when it goes on."""


class PlainDisplay(QuietDisplay):
    """Timed lines for logs and pipes; `verbose` adds the reasons of stages and all decisions."""

    def __init__(self, console: Console | None = None, verbose: bool = False) -> None:
        super().__init__()
        self.console = console or Console(highlight=False, soft_wrap=True)
        self.verbose = verbose
        self._begin = time.monotonic()
        self._last = self._begin
        self._waiting = ""
        self.left = TimeLeft(self._begin)

    def line(self, text: str) -> None:
        """Print a line with the time since the start of the run."""
        self.console.print(cell(f"{_clock(time.monotonic() - self._begin)}  {text}"))

    def preparing(self, done: int, total: int, text: str) -> None:
        """Print once that a stage waits for its kernels, and when it goes on."""
        waiting = text and f"kernels: compiling those of {text} (once per installation)"
        if waiting != self._waiting:
            self._waiting = waiting
            self.line(waiting or _PREPARED)

    def run_started(self, stages: list[Stage]) -> None:
        """Start the clock."""
        self._begin = time.monotonic()

    def stage_reused(self, state: StageState) -> None:
        """Print a stage that needs no work."""
        self.line(f"{state.name}: {_REUSED[state.status]}")

    def stage_started(self, state: StageState) -> None:
        """Print when verbose why a stage runs."""
        self._last = time.monotonic()
        self.left = TimeLeft(self._last, self.expected(state))
        if self.verbose:
            self.line(f"{state.name}: {state.title} ({'; '.join(state.reasons)})")

    def stage_waiting(self, name: str, holder: LeaseHolder | None) -> None:
        """Print once which process holds the lease."""
        text = f"{name}: waiting, {holder or 'another process'} is computing it"
        if text != self._waiting:
            self._waiting = text
            self.line(text)

    def part_started(self, name: str, part: str) -> None:
        """Update the time left."""
        self.left.start_part(time.monotonic(), part)

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """Print a line every PROGRESS_INTERVAL seconds."""
        now = time.monotonic()
        self.left.update(now, done, total)
        if now - self._last < PROGRESS_INTERVAL:
            return
        self._last = now
        parts = [f"{name}: {number(done)} of {number(total)}", text, _live(live), self.left.text(now)]
        self.line(", ".join(part for part in parts if part))

    def decision(self, name: str, what: str, choice: str, evidence: str) -> None:
        """Print a decision when verbose."""
        if self.verbose:
            self.line(f"{name}: {what}: {choice} ({evidence})")

    def stage_stopping(self, name: str) -> None:
        """Print that the stop was received."""
        self.line(f"{name}: stopping; press Ctrl-C again to stop at once")

    def stage_finished(self, state: StageState) -> None:
        """Print time and results of a stage."""
        self.line(f"{state.name}: {_summary(state)}")


class TimeLeftColumn(ProgressColumn):
    """The time left of the running stage, also between its reports."""

    def __init__(self, display: PlainDisplay) -> None:
        super().__init__()
        self.display = display

    def render(self, task: Task) -> Text:
        """The time left in words; nothing beside the compilation of kernels."""
        return Text(f"{self.display.left.text(time.monotonic()) if task.fields.get('stage') else '':>20}")


class TerminalDisplay(PlainDisplay):
    """Progress bar with remaining time and live figures; one line per stage."""

    def __init__(self, verbose: bool = False) -> None:
        super().__init__(verbose=verbose)
        columns = (TextColumn("{task.description:>8}"), BarColumn(32), TaskProgressColumn(), TimeLeftColumn(self))
        note = TextColumn("{task.fields[note]}", markup=False)  # the name of a photo, for example
        self._bar = Progress(*columns, note, console=self.console, transient=True, refresh_per_second=5)
        self._task: TaskID | None = None

    def line(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(cell(text))

    def preparing(self, done: int, total: int, text: str) -> None:
        """A bar of its own while kernels are compiled."""
        if self._task is None:
            self._task = self._bar.add_task("kernels", total=total, note="")
            self._bar.start()
        self._bar.update(self._task, completed=done, total=total, note=f"compiling those of {text}, once per installation")
        if not text:
            self.close()
            self.console.print(_done("kernels").append(_PREPARED.partition(" ")[2], "dim"))

    def stage_reused(self, state: StageState) -> None:
        """Print a stage that needs no work."""
        self.console.print(_done(state.name).append(_REUSED[state.status], "dim"))

    def stage_started(self, state: StageState) -> None:
        """Open the stage's bar."""
        super().stage_started(state)
        self._task = self._bar.add_task(state.name, total=None, note=state.title, stage=True)
        self._bar.start()

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """Update the bar."""
        if self._task is not None:
            note = " ".join(part for part in (text, _live(live)) if part)
            self.left.update(time.monotonic(), done, total)
            self._bar.update(self._task, completed=done, total=total or None, note=printable(note))

    def stage_finished(self, state: StageState) -> None:
        """Replace the bar by the stage's time and results."""
        self.close()
        self.console.print(_done(state.name).append(printable(_summary(state))))

    def close(self) -> None:
        """Remove the bar."""
        if self._task is not None:
            self._bar.remove_task(self._task)
            self._task = None
        self._bar.stop()


def choose_display(*, quiet: bool, verbose: bool, as_json: bool) -> QuietDisplay:
    """The display for the options and the kind of output."""
    if quiet or as_json:
        return QuietDisplay()
    return TerminalDisplay(verbose) if Console().is_terminal else PlainDisplay(verbose=verbose)


def close_display(display: Observer) -> None:
    """Remove the progress bar, if any."""
    if isinstance(display, TerminalDisplay):
        display.close()


def _done(name: str) -> Text:
    """Start of the line of a finished stage."""
    return Text("✓", "green").append(f" {name:<7} ", "")


def _summary(state: StageState) -> str:
    """Time of a stage and its summary, else its first results."""
    manifest: Mapping[str, Any] = state.artifact.manifest if state.artifact is not None else {}
    out = manifest.get("summary") or figures(manifest.get("results", {}))
    return f"{duration(manifest.get('seconds', 0.0)):>12}  {out}".rstrip()


def _live(live: Mapping[str, float]) -> str:
    return " ".join(f"{name} {number(value)}" for name, value in live.items())


def _clock(seconds: float) -> str:
    whole = int(seconds)
    return f"{whole // 3600:d}:{whole // 60 % 60:02d}:{whole % 60:02d}"
