"""Compilation of the kernels ahead of the first run, with a progress of its own.

Numba compiles a kernel when it is first called and keeps the code on the disk. Without this the first run after an installation spends a
minute of every stage on that, and its bars stand still. So the built-in capture is baked once, very small, with the methods of the profile;
a file beside the code records for which sources, versions and processor that was done. GSBAKE_WARM_UP=never leaves it out.
"""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from blake3 import blake3

import gsbake
from gsbake import api
from gsbake.api import Session
from gsbake.config.schema import Profile
from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.pipeline.engine import Observer
from gsbake.pipeline.machine import host_info
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.stage import Stage
from gsbake.stages import REGISTRY

#: Stages with kernels: a run that ends before the first of them needs none.
FIRST = "stereo"
#: Photos of the small capture, and their edge in pixels.
VIEWS, SIZE = 8, 48
#: Settings of the small bake: a few steps of everything that runs.
SMALL = {
    "stereo.enabled": "always", "stereo.max_size": 64, "train.iterations": 12, "train.init_surfels": 300, "refine.iterations": 4,
    "mesh.resolution": 32, "mesh.faces": 400, "bake.size": 128, "bake.occlusion_rays": 4, "bake.fit_iterations": 4, "report.views": 1,
    "report.view_size": 32,
}  # fmt: skip
#: Settings whose choice decides which kernels run.
METHODS = ("surfels.shading", "surfels.transfer", "surfels.sh_degree", "bake.materials", "bake.visibility", "mesh.field")


class Line(Protocol):
    """A display with a line for the compilation."""

    def preparing(self, done: int, total: int, text: str) -> None:
        """The compilation is at stage `done` of `total`; `text` names the stage, empty at the end."""


class _Progress(Observer):
    """Passes the stages of the small bake to the display as one progress."""

    def __init__(self, display: Line) -> None:
        self.display, self.total, self.done = display, 1, 0

    def run_started(self, stages: list[Stage]) -> None:
        """Count the stages."""
        self.total = len(stages)

    def stage_started(self, state: StageState) -> None:
        """Show the stage."""
        self.display.preparing(self.done, self.total, state.name)

    def stage_finished(self, state: StageState) -> None:
        """Count a finished stage."""
        self.done += 1


def compile_kernels(session: Session, until: str | None, display: Line) -> bool:
    """Compile the kernels that the session's profile needs, unless that was done; whether it was done now.

    Raises InterruptedRun on a stop request. Any other failure is left to the run itself to report.
    """
    registry = session.engine.registry
    names = registry.names if until is None else tuple(stage.name for stage in registry.up_to(until))
    own = registry.references.get(FIRST) == REGISTRY.references[FIRST]
    if os.environ.get("GSBAKE_WARM_UP") == "never" or not own or FIRST not in names:
        return False
    record = _record(session.profile.profile)
    if record is None or record.exists():
        return False
    from gsbake.synth.capture import write_capture

    with tempfile.TemporaryDirectory(prefix="gsbake-kernels-") as folder:
        capture, out = Path(folder) / "capture", Path(folder) / "out"
        write_capture(capture, views=VIEWS, size=SIZE)
        try:
            settings = _settings(session.profile.profile)
            api.run(capture, out=out, profile="smoke", settings=settings, observer=_Progress(display), until="bake")
        except InterruptedRun:
            raise
        except GsbakeError:
            return False
    record.write_text("")
    display.preparing(1, 1, "")
    return True


def _settings(profile: Profile) -> Mapping[str, Any]:
    values = profile.model_dump(mode="json")
    return SMALL | {key: values[key.partition(".")[0]][key.partition(".")[2]] for key in METHODS}


def _record(profile: Profile) -> Path | None:
    """The file that records the compilation for this code, machine and choice of methods; None where it cannot be written."""
    package = Path(gsbake.__file__).parent
    hasher = blake3()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if b"njit" in content:
            hasher.update(content)
    values = profile.model_dump(mode="json")
    chosen = [str(values[key.partition(".")[0]][key.partition(".")[2]]) for key in METHODS]
    machine = (sys.version, version("numba"), platform.machine(), str(host_info().get("cpu")))
    hasher.update("\n".join((*machine, *chosen)).encode())
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or package / "__pycache__")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder / f"kernels-{hasher.hexdigest(8)}.compiled" if os.access(folder, os.W_OK) else None
