"""Access to the settings that a stage declares.

Reading an undeclared field raises: the field is not part of the cache key, so a change of it would go unnoticed.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel


class UndeclaredSetting(Exception):
    """A stage read a profile field that it does not declare. Not an AttributeError, so that getattr's default cannot hide it."""


def flatten(profile: BaseModel) -> dict[str, Any]:
    """{"section.key": JSON value} of all fields of a profile."""
    out: dict[str, Any] = {}
    for name, section in profile:
        if isinstance(section, BaseModel):
            out.update({f"{name}.{key}": value for key, value in section.model_dump(mode="json").items()})
    return out


def defaults(profile: type[BaseModel]) -> dict[str, Any]:
    """{"section.key": JSON value} of the schema's defaults."""
    return flatten(profile())


def expand_patterns(patterns: Iterable[str], names: Iterable[str]) -> list[str]:
    """Sorted names that match the patterns ("train.iterations", "train.*"). Raises UndeclaredSetting for a pattern without match."""
    names = list(names)
    selected: set[str] = set()
    for pattern in patterns:
        matches = fnmatch.filter(names, pattern)
        if not matches:
            raise UndeclaredSetting(f"the declared setting '{pattern}' matches no field of the profile")
        selected.update(matches)
    return sorted(selected)


class SettingsView:
    """The declared fields of a profile as `view.section.key`; any other field raises UndeclaredSetting."""

    def __init__(self, profile: BaseModel, patterns: Iterable[str], stage: str = "this stage") -> None:
        self._profile = profile
        self._stage = stage
        self._names = frozenset(expand_patterns(patterns, flatten(profile)))

    def __getattr__(self, section: str) -> Any:
        if section.startswith("_"):
            raise AttributeError(section)
        model = getattr(self._profile, section, None)
        if not isinstance(model, BaseModel):
            raise UndeclaredSetting(f"stage '{self._stage}' reads section '{section}', which the profile does not have")
        if all(f"{section}.{key}" in self._names for key in type(model).model_fields):
            return model  # all fields are declared: return the typed section
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
