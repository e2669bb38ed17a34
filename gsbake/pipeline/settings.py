"""The settings a stage declared, and a guard around all others.

A stage that read a field it did not declare would be served from the cache although that field had changed; so reading one raises.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel


class UndeclaredSetting(Exception):
    """A stage read a profile field that its declaration does not list (not an AttributeError, so getattr's default cannot hide it)."""


def flatten(profile: BaseModel) -> dict[str, Any]:
    """{"section.key": value as JSON} of every field in every section of a profile."""
    out: dict[str, Any] = {}
    for name, section in profile:
        if isinstance(section, BaseModel):
            out.update({f"{name}.{key}": value for key, value in section.model_dump(mode="json").items()})
    return out


def defaults(profile: type[BaseModel]) -> dict[str, Any]:
    """{"section.key": the schema's default as JSON}."""
    return flatten(profile())


def declared(patterns: Iterable[str], names: Iterable[str]) -> list[str]:
    """The names that the patterns ("train.iterations", "train.*") select, sorted; a pattern that selects none is an error."""
    names = list(names)
    chosen: set[str] = set()
    for pattern in patterns:
        hits = fnmatch.filter(names, pattern)
        if not hits:
            raise UndeclaredSetting(f"the declared setting '{pattern}' matches no field of the profile")
        chosen.update(hits)
    return sorted(chosen)


class SettingsView:
    """`view.train.iterations`: the declared fields of a profile, by section; any other raises UndeclaredSetting."""

    def __init__(self, profile: BaseModel, patterns: Iterable[str], stage: str = "this stage") -> None:
        self._profile = profile
        self._stage = stage
        self._names = frozenset(declared(patterns, flatten(profile)))

    def __getattr__(self, section: str) -> Any:
        if section.startswith("_"):
            raise AttributeError(section)
        model = getattr(self._profile, section, None)
        if not isinstance(model, BaseModel):
            raise UndeclaredSetting(f"stage '{self._stage}' reads section '{section}', which the profile does not have")
        if all(f"{section}.{key}" in self._names for key in type(model).model_fields):
            return model  # all of it is declared: the section itself, with its type
        return SectionView(model, section, self._names, self._stage)


class SectionView:
    """One section of a SettingsView."""

    def __init__(self, model: BaseModel, section: str, names: frozenset[str], stage: str) -> None:
        self._model, self._section, self._names, self._stage = model, section, names, stage

    def __getattr__(self, key: str) -> Any:
        if key.startswith("_"):
            raise AttributeError(key)
        name = f"{self._section}.{key}"
        if name not in self._names:
            raise UndeclaredSetting(f"stage '{self._stage}' reads the setting '{name}' without declaring it")
        return getattr(self._model, key)
