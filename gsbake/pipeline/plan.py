"""Planning: the state of each stage (cached, replaced, or to be run) and the settings and files that changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from gsbake.errors import BadInputError
from gsbake.pipeline.digest import tree_digest
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.settings import defaults, expand_patterns, flatten
from gsbake.pipeline.stage import Stage
from gsbake.pipeline.store import Artifact, Store
from gsbake.text import shortlist


@dataclass(frozen=True)
class Request:
    """A requested run: output folder, the user's input paths by name, and settings.

    `source_names` lists, per source that is a folder, the relative names of its files that are inputs; without an entry, all files
    directly in it.
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
    """State of a stage: `cached`, `replaced` (by the user's files), `run`, or `waits` (an earlier stage has to run first)."""

    name: str
    title: str
    status: Literal["cached", "replaced", "run", "waits"]
    reasons: tuple[str, ...] = ()
    cache_key: CacheKey | None = None
    artifact: Artifact | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


class Planner:
    """Determines the states of stages from the artifacts in the store."""

    def __init__(self, request: Request, store: Store) -> None:
        self.request = request
        self.store = store
        self._settings = flatten(request.profile)
        self._defaults = defaults(type(request.profile))
        self._sources: dict[str, dict[str, str]] = {}

    def plan(self, stages: Iterable[Stage]) -> list[StageState]:
        """The states of the stages, in order; nothing is run."""
        states: list[StageState] = []
        artifacts: dict[str, Artifact] = {}
        for stage in stages:
            state = self.assess(stage, artifacts)
            if state.artifact is not None:
                artifacts[stage.name] = state.artifact
            states.append(state)
        return states

    def plan_empty(self, stages: Iterable[Stage]) -> list[StageState]:
        """The states of the stages where nothing is stored: all have to run. No input is read, so there are no keys."""
        return [
            StageState(stage.name, stage.title, "waits" if stage.needs else "run", ("not run yet",), settings=self._declared(stage))
            for stage in stages
        ]

    def assess(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> StageState:
        """The state of one stage, given the artifacts of earlier stages."""
        settings = self._declared(stage)
        replacement = self.store.replacement(stage.name)
        if replacement is not None:
            if replacement.artifact is None:
                raise BadInputError(
                    f"The replaced output of stage '{stage.name}' is damaged ({replacement.faults[0]}): "
                    f"replace it again with `gsbake replace {stage.name} FILE`, or undo with `gsbake replace {stage.name} --undo`."
                )
            return StageState(stage.name, stage.title, "replaced", ("replaced by the user",), None, replacement.artifact, settings)
        missing = [need for need in stage.needs if need not in artifacts]
        if missing:
            changes = self._changes(stage, settings, {})
            return StageState(stage.name, stage.title, "waits", (f"{shortlist(missing)} will run first", *changes), settings=settings)
        cache_key = self.cache_key(stage, artifacts)
        found = self.store.look_up(cache_key)
        if found.artifact is not None:
            return StageState(stage.name, stage.title, "cached", (), cache_key, found.artifact, settings)
        reasons = found.faults or self._changes(stage, settings, self.input_files(stage, artifacts), cache_key)
        return StageState(stage.name, stage.title, "run", reasons, cache_key, None, settings)

    def cache_key(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> CacheKey:
        """The key of a stage whose needed stages have `artifacts`. Raises BadInputError for a user's file that cannot be read."""
        settings = self._declared(stage)
        return CacheKey.for_stage(
            stage,
            settings,
            {name: self._defaults[name] for name in settings},
            {name: tree_digest(entry) for name, entry in self.input_files(stage, artifacts).items()},
            device=self.request.device,
            seed=self.request.seed,
        )

    def _declared(self, stage: Stage) -> dict[str, Any]:
        """{"section.key": value} of the settings that a stage declares."""
        return {name: self._settings[name] for name in expand_patterns(stage.settings, self._settings)}

    def input_files(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> dict[str, Mapping[str, str]]:
        """{input: {file: digest}} of the artifacts and the user's paths that the stage reads."""
        files: dict[str, Mapping[str, str]] = {need: artifacts[need].files for need in stage.needs}
        for name in stage.sources:
            if name in self.request.sources:
                files[name] = self._source(name)
        return files

    def input_paths(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> list[Path]:
        """The files that the stage reads."""
        paths = [artifacts[need].folder / name for need in stage.needs for name in artifacts[need].files]
        for name in stage.sources:
            if name in self.request.sources:
                source = self.request.sources[name]
                paths += [source / file if source.is_dir() else source for file in self._source(name)]
        return paths

    def forget_sources(self) -> None:
        """Look at the user's files again at the next question."""
        self._sources = {}

    def _source(self, name: str) -> dict[str, str]:
        if name not in self._sources:
            path = self.request.sources[name]
            try:
                self._sources[name] = self.store.digests.source(path, self.request.source_names.get(name))
            except OSError as error:
                raise BadInputError(f"'{path}' ({name}) cannot be read: {error.strerror}.") from error
        return self._sources[name]

    def _changes(
        self, stage: Stage, settings: Mapping[str, Any], files: Mapping[str, Mapping[str, str]], cache_key: CacheKey | None = None
    ) -> tuple[str, ...]:
        """Differences from the stage's newest artifact; without `cache_key`, of settings and version only."""
        manifests = self.store.manifests(stage.name)
        if not manifests:
            return ("not run yet",)
        old = manifests[0][1]
        changes = []
        if old.get("version") != stage.version:
            changes.append(f"stage version: {old.get('version')} → {stage.version}")
        recorded = old.get("settings", {})
        for name, value in settings.items():
            before = recorded.get(name, self._defaults[name])
            if before != value:
                changes.append(f"{name}: {_toml(before)} → {_toml(value)}")
        if cache_key is not None:
            for label, field_name in (("device", "backend"), ("seed", "seed")):
                if old.get(field_name) != getattr(cache_key, field_name):
                    changes.append(f"{label}: {_toml(old.get(field_name))} → {_toml(getattr(cache_key, field_name))}")
            known = old.get("inputs", {})
            for name in sorted({*known, *files}):
                changes += _file_changes(name, known.get(name, {}).get("files"), files.get(name))
            if not changes:
                changes.append("the artifact of these inputs is missing")
        return tuple(changes)


def _file_changes(name: str, old: Mapping[str, str] | None, new: Mapping[str, str] | None) -> list[str]:
    """Description of how the files of an input differ; empty when they do not."""
    if old is None or new is None:
        return [] if old is new else [f"{name}: {'removed' if new is None else 'added'}"]
    kinds = {
        "changed": [f for f in new if f in old and old[f] != new[f]],
        "added": [f for f in new if f not in old],
        "removed": [f for f in old if f not in new],
    }
    parts = [f"{shortlist(files)} {kind}" for kind, files in kinds.items() if files]
    return [f"{name}: {', '.join(parts)}"] if parts else []


def _toml(value: Any) -> str:
    """A scalar setting in TOML notation."""
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else f'"{value}"' if isinstance(value, str) else str(value)
