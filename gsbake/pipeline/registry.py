"""The ordered stages of a pipeline, loaded by reference ("module:attribute") only when they are needed.

A reference, not an object, is what crosses to the worker process; it also keeps `--help` from importing any stage.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from gsbake.errors import UsageError
from gsbake.pipeline.stage import Stage


def load_stage(reference: str) -> Stage:
    """The stage that "module:attribute" names."""
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
        """The stage called `name`; UsageError when there is none."""
        if name not in self.references:
            raise UsageError(f"There is no stage '{name}'; the stages are {', '.join(self.names)}.")
        return load_stage(self.references[name])

    def up_to(self, target: str | None = None) -> list[Stage]:
        """`target` and every stage it needs, directly or not, in running order; all stages without a target."""
        if target is None:
            return [self.load(name) for name in self.names]
        wanted = {target}
        stages = []
        for name in reversed(self.names):
            if name in wanted:
                stage = self.load(name)
                wanted.update(stage.needs)
                stages.append(stage)
        if not stages:
            self.load(target)
        return stages[::-1]
