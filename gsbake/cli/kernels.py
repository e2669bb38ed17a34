"""Compilation of the kernels that a run needs, beside its first stages.

Numba compiles a kernel when it is first called and keeps the code on the disk. Left to itself the first run after an installation would
compile one kernel after the other inside the stages, with bars that stand still. Here processes compile them while the first stages
work, in the order in which stages need them; a stage waits for its own. GSBAKE_COMPILE=never leaves that out.

`python -m gsbake.cli.kernels` compiles the kernels of all stages at once: for container images, and ahead of the tests.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from gsbake.api import Session
from gsbake.config.load import load_profile
from gsbake.kernels.compilation import Compilation
from gsbake.pipeline.machine import available_cores
from gsbake.pipeline.stage import Stage
from gsbake.stages import REGISTRY

#: Most processes: each takes some 300 MB, and all kernels together a minute of one core.
MAX_PROCESSES = 4


class Line(Protocol):
    """A display with a line for the compilation."""

    def preparing(self, done: int, total: int, text: str) -> None:
        """A stage waits for its kernels, of which `done` of `total` modules are compiled; `text` names the stage, empty when it goes on."""


@contextmanager
def compiling(session: Session, until: str | None, display: Line) -> Iterator[None]:
    """Compile the kernels of a session's stages up to `until` (None: all) while the block runs, from the first stage that computes on."""
    if os.environ.get("GSBAKE_COMPILE") == "never":
        yield
        return
    settings = session.profile.profile
    modules = [name for stage in session.engine.registry.up_to(until) for name in stage.kernels(settings)]
    compilation = Compilation(modules, processes())

    def before_stage(stage: Stage, check: Callable[[], None]) -> None:
        compilation.start()
        waited = False

        def report(done: int, total: int) -> None:
            nonlocal waited
            waited = True
            display.preparing(done, total, stage.name)

        compilation.wait(stage.kernels(settings), check, report)
        if waited:
            display.preparing(1, 1, "")

    session.engine.before_stage = before_stage
    try:
        yield
    finally:
        compilation.close()


def processes() -> int:
    """Number of processes that compile at once."""
    return min(MAX_PROCESSES, available_cores())


def main() -> None:
    """Compile the kernels of all stages for the default settings."""
    settings = load_profile("relight").profile
    modules = [name for stage in REGISTRY.up_to() for name in stage.kernels(settings)]
    compilation = Compilation(modules, processes())
    missing = compilation.start()
    compilation.wait(modules, lambda: None, lambda done, total: None)
    compilation.close()
    sys.stdout.write(f"Kernels of {len(missing)} modules compiled.\n")


if __name__ == "__main__":
    main()
