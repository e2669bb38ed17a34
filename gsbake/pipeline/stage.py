"""What a stage is: its declaration, and the context it runs in.

A stage is a plain function from files to files. It reads only the inputs and settings it declares, writes into `ctx.out`
(a temporary folder that the engine publishes atomically), and returns its figures for the manifest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


class Context(Protocol):
    """What the engine hands to a running stage."""

    out: Path  # empty folder to fill; published when the stage returns
    inputs: Mapping[str, Path]  # needed stage -> its artifact folder; "photos"/"masks"/"poses" -> the person's paths, when given
    settings: Any  # ctx.settings.train.iterations; reading an undeclared field raises
    seed: int
    threads: int
    device: str  # "cpu" or "cuda"
    checkpoint: Path  # folder that survives an interruption of this stage and vanishes when it is published

    def part(self, name: str) -> AbstractContextManager[None]:
        """Time a part of the stage; the seconds go into the manifest."""

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Report progress and live figures (psnr=…); cheap enough to call every step."""

    def stop_requested(self) -> bool:
        """Whether SIGINT/SIGTERM came; a stage with checkpoints writes one and calls `check_stop`."""

    def check_stop(self) -> None:
        """Raise InterruptedRun if a stop was requested."""

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Log a decision taken from evidence ("structure from motion", "skipped", "poses given"); shown in the report.

        `saved` is the time in seconds that it saved, where that was measured or follows from what was.
        """

    def warn(self, text: str) -> None:
        """Warn the person; also kept in the manifest."""


@dataclass(frozen=True)
class Stage:
    """Declaration of a stage.

    `needs` names the stages whose folders it reads, `sources` which of the person's paths ("photos", "masks", "poses") it reads,
    `settings` the profile fields ("train.iterations" or "train.*"). `run` returns JSON-able results for the manifest.
    """

    name: str
    version: int
    title: str
    run: Callable[[Context], dict[str, Any]]
    needs: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    uses_device: bool = False  # the backend class (cpu/cuda) is part of the key
    seeded: bool = False  # the seed is part of the key
