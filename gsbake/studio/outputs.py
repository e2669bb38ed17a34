"""What the stages of a capture's run have written: the outputs that its settings ask for, else the newest ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError
from gsbake.pipeline.store import Store
from gsbake.stages import REGISTRY
from gsbake.studio.sessions import session_of
from gsbake.studio.workspace import Capture, NotFoundError


@dataclass(frozen=True)
class Output:
    """The folder and manifest of a stage's output."""

    folder: Path
    manifest: Mapping[str, Any]

    @property
    def results(self) -> Mapping[str, Any]:
        """The figures that the stage reported."""
        found: Mapping[str, Any] = self.manifest.get("results", {})
        return found


def outputs(capture: Capture) -> dict[str, Output]:
    """{stage: output} of the stages that have one."""
    found: dict[str, Output] = {}
    if not (capture.out / "stages").is_dir():
        return found
    store = Store(capture.out)
    for stage in REGISTRY.names:
        for folder, manifest in store.manifests(stage)[:1]:
            found[stage] = Output(folder, manifest)
    with suppress(GsbakeError, OSError):
        for state in session_of(capture).engine.plan():
            if state.artifact is not None:
                found[state.name] = Output(state.artifact.folder, state.artifact.manifest)
    return found


def required(capture: Capture, *stages: str) -> list[Output]:
    """Outputs of these stages. Raises NotFoundError where one is missing."""
    found = outputs(capture)
    missing = [stage for stage in stages if stage not in found]
    if missing:
        raise NotFoundError(f"{capture.name} has no output of the stage {missing[0]} yet; run it first.")
    return [found[stage] for stage in stages]


def entries(ingest: Output) -> list[dict[str, Any]]:
    """The entries of photos.json, by which names and files of photos are known."""
    found: list[dict[str, Any]] = json.loads((ingest.folder / "photos.json").read_text(encoding="utf-8"))["photos"]
    return found
