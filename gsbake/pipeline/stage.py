"""Declaration of a stage, and the context that it runs in.

A stage is a function from files to files. It reads only the inputs and settings it declares, writes into `ctx.out` (a temporary folder
that the engine publishes atomically), and returns its results for the manifest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gsbake.monitor import Monitor


class Context(Monitor, Protocol):
    """What the engine passes to a running stage; also the monitor of its step."""

    out: Path  # empty folder to fill; published when the stage returns
    inputs: Mapping[str, Path]  # needed stage -> its artifact folder; "photos"/"masks"/"poses" -> the user's paths, when given
    settings: Any  # ctx.settings.train.iterations; reading an undeclared field raises UndeclaredSetting
    seed: int
    threads: int
    device: str  # "cpu" or "cuda"
    checkpoint: Path  # folder that survives an interruption of this stage; deleted when the artifact is published
    cache: Path  # folder, not made yet, for parts of the work that later runs of this stage use again; found by content, never needed


@dataclass(frozen=True)
class Stage:
    """Declaration of a stage.

    `needs` names the stages whose artifacts it reads, `sources` which of the user's paths ("photos", "masks", "poses") it reads,
    `settings` the profile fields ("train.iterations" or "train.*"). `run` returns JSON-serialisable results for the manifest.
    """

    name: str
    version: int
    title: str
    run: Callable[[Context], dict[str, Any]]
    needs: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    summary: str = ""  # what came out in a few words, with results in braces: "{photos} photos, {masks} masks"
    uses_device: bool = False  # the backend (cpu or cuda) is part of the cache key
    seeded: bool = False  # the seed is part of the cache key
    kernels: Callable[[Any], Sequence[str]] = lambda settings: ()  # modules whose compiled kernels it calls, for these settings
