"""Registry of the pipeline's stages in running order, loaded on demand from "module:attribute" references.

References, not objects, are sent to worker processes; they also keep `--help` from importing stages.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from gsbake.errors import UsageError
from gsbake.pipeline.stage import Stage


def load_stage(reference: str) -> Stage:
    """Import the stage at "module:attribute". Raises TypeError when it is not a Stage."""
    module, _, attribute = reference.partition(":")
    stage = getattr(importlib.import_module(module), attribute)
    if not isinstance(stage, Stage):
        raise TypeError(f"{reference} is a {type(stage).__name__}, not a Stage")
    return stage


class Registry:
    """Stages by name, in running order."""

    def __init__(self, references: Mapping[str, str]) -> None:
        self.references = dict(references)

    @property
    def names(self) -> tuple[str, ...]:
        """All stage names in running order."""
        return tuple(self.references)

    def load(self, name: str) -> Stage:
        """The stage `name`. Raises UsageError when there is none."""
        if name not in self.references:
            raise UsageError(f"There is no stage '{name}'; the stages are {', '.join(self.names)}.")
        return load_stage(self.references[name])

    def without(self, name: str) -> Registry:
        """The stages but one, which no other needs."""
        return Registry({key: reference for key, reference in self.references.items() if key != name})

    def up_to(self, until: str | None = None) -> list[Stage]:
        """The stage `until` and its direct and indirect dependencies in running order; all stages without one."""
        if until is None:
            return [self.load(name) for name in self.names]
        wanted = {until}
        stages = []
        for name in reversed(self.names):
            if name in wanted:
                stage = self.load(name)
                wanted.update(stage.needs)
                stages.append(stage)
        if not stages:
            self.load(until)
        return stages[::-1]
