"""How a step talks to whoever runs it: progress, timed parts, decisions, warnings and stop requests.

Every step of the pipeline is a function of plain paths and options that takes a `Monitor`. The engine passes one that reports to the
terminal and the manifest; without one, `SILENT` ignores everything.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Literal, Protocol

#: Whether work that a scene may not need is skipped: by evidence, in any case, or not at all.
Rule = Literal["auto", "always", "never"]
#: Decisions about skipped work are named after their setting: "skip." and the rule.
SKIP_PREFIX = "skip."


class Monitor(Protocol):
    """Receives what a running step reports."""

    def part(self, name: str) -> AbstractContextManager[None]:
        """Time a part of the step; parts of one name add up."""

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Report progress and live figures (psnr=…); cheap enough to call in every iteration."""

    def stop_requested(self) -> bool:
        """Whether the step should write a checkpoint and stop; `check_stop` then raises."""

    def check_stop(self) -> None:
        """Raise InterruptedRun if a stop was requested."""

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Record a decision and its evidence; `saved` is the time in seconds that it saves, where that was measured."""

    def warn(self, text: str) -> None:
        """Record a warning for the user."""


class SilentMonitor:
    """A monitor that ignores all reports and never asks to stop."""

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


def skips(rule: Rule, holds: bool) -> bool:
    """Whether work is skipped: as the evidence says (`holds`), unless the setting says always or never."""
    return holds if rule == "auto" else rule == "always"


def decide_skip(
    monitor: Monitor, name: str, rule: Rule, holds: bool, evidence: str, skipped: str, done: str, saved: float | None = None
) -> bool:
    """Decide whether to skip the work of the setting skip.`name`, and report it; returns whether it is skipped.

    `holds` and `evidence` say whether the measurements allow it and why; `skipped` and `done` name either outcome. `saved` is the time in
    seconds that skipping saves, None where it is unknown.
    """
    skip = skips(rule, holds)
    if rule != "auto":
        evidence += "; set by the profile"
    monitor.decide(SKIP_PREFIX + name, skipped if skip else done, evidence, saved if skip else None)
    return skip
