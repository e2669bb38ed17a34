"""What each stage would do now, and why: cached, replaced by hand, or to be run because this field or that file changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from gsbake.errors import BadInputError
from gsbake.pipeline.digest import tree_digest
from gsbake.pipeline.key import Ingredients
from gsbake.pipeline.settings import declared, defaults, flatten
from gsbake.pipeline.stage import Stage
from gsbake.pipeline.store import Artifact, Store

#: Changed files named in a reason before it only counts them.
_NAMED = 3


@dataclass(frozen=True)
class Request:
    """What is asked for: where, from which of the person's paths, with which settings.

    `source_names` lists, per source that is a folder, the files in it that count (relative names); without an entry, those that
    lie directly in it.
    """

    out: Path
    sources: Mapping[str, Path]
    profile: BaseModel
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    source_names: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class StageState:
    """What a stage would do: `cached`, `replaced` (by hand), `run`, or `waits` (for a stage before it that runs first)."""

    name: str
    title: str
    status: Literal["cached", "replaced", "run", "waits"]
    reasons: tuple[str, ...] = ()
    ingredients: Ingredients | None = None
    artifact: Artifact | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


class Planner:
    """Assesses stages against what the store holds."""

    def __init__(self, request: Request, store: Store) -> None:
        self.request = request
        self.store = store
        self._settings = flatten(request.profile)
        self._defaults = defaults(type(request.profile))
        self._sources: dict[str, dict[str, str]] = {}

    def plan(self, stages: Iterable[Stage]) -> list[StageState]:
        """The state of every stage, in order, without running any."""
        states: list[StageState] = []
        artifacts: dict[str, Artifact] = {}
        for stage in stages:
            state = self.assess(stage, artifacts)
            if state.artifact is not None:
                artifacts[stage.name] = state.artifact
            states.append(state)
        return states

    def assess(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> StageState:
        """The state of one stage, given the artifacts that exist of the stages before it."""
        names = declared(stage.settings, self._settings)
        settings = {name: self._settings[name] for name in names}
        replacement = self.store.replacement(stage.name)
        if replacement is not None:
            if replacement.artifact is None:
                raise BadInputError(
                    f"The output put in place of stage '{stage.name}' by hand is damaged ({replacement.faults[0]}): "
                    f"give it again with `gsbake replace {stage.name} FILE`, or take it back with `gsbake replace {stage.name} --undo`."
                )
            return StageState(stage.name, stage.title, "replaced", ("put in place by hand",), None, replacement.artifact, settings)
        missing = [need for need in stage.needs if need not in artifacts]
        if missing:
            changes = self._changes(stage, settings, {})
            return StageState(stage.name, stage.title, "waits", (f"{_listing(missing)} will run first", *changes), settings=settings)
        files = self.input_files(stage, artifacts)
        what = Ingredients.of(
            stage,
            settings,
            {name: self._defaults[name] for name in names},
            {name: tree_digest(entry) for name, entry in files.items()},
            device=self.request.device,
            seed=self.request.seed,
        )
        found = self.store.look_up(what)
        if found.artifact is not None:
            return StageState(stage.name, stage.title, "cached", (), what, found.artifact, settings)
        reasons = found.faults or self._changes(stage, settings, files, what)
        return StageState(stage.name, stage.title, "run", reasons, what, None, settings)

    def input_files(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> dict[str, Mapping[str, str]]:
        """{input: {file: digest}} of the needed stages' artifacts and of the person's paths that the stage reads."""
        files: dict[str, Mapping[str, str]] = {need: artifacts[need].files for need in stage.needs}
        for name in stage.sources:
            if name in self.request.sources:
                files[name] = self._source(name)
        return files

    def _source(self, name: str) -> dict[str, str]:
        if name not in self._sources:
            path = self.request.sources[name]
            try:
                self._sources[name] = self.store.digests.source(path, self.request.source_names.get(name))
            except OSError as error:
                raise BadInputError(f"'{path}' ({name}) cannot be read: {error.strerror}.") from error
        return self._sources[name]

    def _changes(
        self, stage: Stage, settings: Mapping[str, Any], files: Mapping[str, Mapping[str, str]], what: Ingredients | None = None
    ) -> tuple[str, ...]:
        """What differs from the stage's newest artifact; without `what` only settings and version are compared."""
        manifests = self.store.manifests(stage.name)
        if not manifests:
            return ("it has not run yet",)
        old = manifests[0][1]
        changes = []
        if old.get("version") != stage.version:
            changes.append(f"stage version: {old.get('version')} → {stage.version}")
        recorded = old.get("settings", {})
        for name, value in settings.items():
            before = recorded.get(name, self._defaults[name])
            if before != value:
                changes.append(f"{name}: {_show(before)} → {_show(value)}")
        if what is not None:
            for label, field_name in (("device", "backend"), ("seed", "seed")):
                if old.get(field_name) != getattr(what, field_name):
                    changes.append(f"{label}: {_show(old.get(field_name))} → {_show(getattr(what, field_name))}")
            known = old.get("inputs", {})
            for name in sorted({*known, *files}):
                changes += _file_changes(name, known.get(name, {}).get("files"), files.get(name))
            if not changes:
                changes.append("its output for exactly these inputs is gone")
        return tuple(changes)


def _file_changes(name: str, old: Mapping[str, str] | None, new: Mapping[str, str] | None) -> list[str]:
    """How an input's files differ, in words."""
    if old is None or new is None:
        return [] if old is new else [f"{name}: {'no longer given' if new is None else 'given now, not before'}"]
    kinds = {
        "changed": [f for f in new if f in old and old[f] != new[f]],
        "added": [f for f in new if f not in old],
        "removed": [f for f in old if f not in new],
    }
    parts = [f"{_listing(files)} {kind}" for kind, files in kinds.items() if files]
    return [f"{name}: {', '.join(parts)}"] if parts else []


def _listing(names: list[str]) -> str:
    """The first few names, and how many more."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _show(value: Any) -> str:
    """A value as TOML writes it, near enough."""
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else f'"{value}"' if isinstance(value, str) else str(value)
