"""Interface through which a step reports progress, timed parts, decisions and warnings, and receives stop requests.

Every step of the pipeline is a function of plain paths and options that takes a `Monitor`. The engine passes one that reports to the
terminal and the manifest; the default, `SILENT`, ignores all reports.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Literal, Protocol

#: Rule of [skip]: the work is left out where measurements allow it (auto), in any case (skip), or in none (keep).
Rule = Literal["auto", "skip", "keep"]
#: Prefix of decisions about skipped work; the rest is the rule, as in the setting's name.
SKIP_PREFIX = "skip."


class Monitor(Protocol):
    """Receives the reports of a running step."""

    def part(self, name: str) -> AbstractContextManager[None]:
        """Time a part of the step; times of parts with the same name are added. Parts do not overlap."""

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Report progress and live figures (psnr=…); fast enough for every iteration."""

    def stop_requested(self) -> bool:
        """Whether the step must write a checkpoint and stop; `check_stop` then raises."""

    def check_stop(self) -> None:
        """Raise InterruptedRun if a stop was requested."""

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Record a decision and its evidence; `saved` is the time in seconds that it saves, None where unknown."""

    def warn(self, text: str) -> None:
        """Record a warning for the user."""


class SilentMonitor:
    """A monitor that ignores all reports and never requests a stop."""

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Run the part untimed."""
        yield

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Ignore progress."""

    def stop_requested(self) -> bool:
        """Never."""
        return False

    def check_stop(self) -> None:
        """Never raise."""

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Ignore a decision."""

    def warn(self, text: str) -> None:
        """Ignore a warning."""


SILENT = SilentMonitor()


class PartSequence:
    """Parts that follow each other, for progress that is named only when it is reported: a part ends when the next one starts."""

    def __init__(self, monitor: Monitor) -> None:
        self.monitor, self.name = monitor, ""
        self._open = ExitStack()

    def __enter__(self) -> PartSequence:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def start(self, name: str) -> None:
        """Start the part `name`, unless it is the present one."""
        if name != self.name:
            self._open.close()
            self._open.enter_context(self.monitor.part(name))
            self.name = name


def skips(rule: Rule, holds: bool) -> bool:
    """Whether work is left out: where measurements allow it (`holds`), unless the rule is skip or keep."""
    return holds if rule == "auto" else rule == "skip"


def decide_skip(
    monitor: Monitor, name: str, rule: Rule, holds: bool, evidence: str, skipped: str, done: str, saved: float | None = None
) -> bool:
    """Decide whether to skip the work of the setting skip.`name`, and report the decision; returns whether it is skipped.

    `holds`: the measurements allow skipping, `evidence`: these measurements; `skipped` and `done` name the two outcomes. `saved`: time in
    seconds that skipping saves, None where unknown.
    """
    skip = skips(rule, holds)
    if rule != "auto":
        evidence += "; set by the profile"
    monitor.decide(SKIP_PREFIX + name, skipped if skip else done, evidence, saved if skip else None)
    return skip
