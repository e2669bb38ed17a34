"""Values of settings that have a new name: the old ones are taken for one version, with a warning, and give the same cache keys."""

from __future__ import annotations

import warnings
from typing import Any

from gsbake.errors import RenamedValueWarning
from gsbake.text import printable

#: {section: {old value: present value}}, of all settings of the section.
RENAMED = {"skip": {"always": "skip", "never": "keep"}}


def present_value(key: str, value: Any, where: str) -> Any:
    """The present name of the `value` of the setting `key`; warns of an old one, found in `where` ("--set" or a file)."""
    new = _present(key, value)
    if new is None:
        return value
    text = printable(f'{where}: {key} = "{value}" is now "{new}"; the next version takes the new value alone.')
    warnings.warn(text, RenamedValueWarning, stacklevel=2)
    return new


def present_override(text: str) -> str:
    """The override "section.key=value" with the present name of its value."""
    key, _, value = text.partition("=")
    new = _present(key.strip(), value.strip().strip("\"'"))
    return text if new is None else f"{key.strip()}={new}"


def _present(key: str, value: Any) -> str | None:
    """The present name of an old value; None for any other."""
    return RENAMED.get(key.partition(".")[0], {}).get(value) if isinstance(value, str) else None
