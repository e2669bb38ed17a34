"""Command and environment of every Python process that gsbake starts.

A child never imports from the current folder, which may hold untrusted files beside the photos: `-P` keeps the current folder and the
script's folder off the search path, and PYTHONPATH is set to this process's own absolute search path without the current folder. Other
PYTHON* variables are dropped, except those that only choose encodings, warnings and byte code. The other descriptors are closed by
`subprocess` (`close_fds`), and no shell is involved.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

#: PYTHON* variables that cannot make a child run other code.
_HARMLESS = frozenset({
    "PYTHONDONTWRITEBYTECODE", "PYTHONHASHSEED", "PYTHONPYCACHEPREFIX", "PYTHONUTF8", "PYTHONWARNINGS", "PYTHONFAULTHANDLER",
})  # fmt: skip


def python_command(*arguments: str) -> list[str]:
    """The command that runs this Python with `arguments`, such as "-m", "package.module"."""
    return [sys.executable, "-P", *arguments]


def python_environment(variables: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment of a child, with `variables` on top."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON") or k in _HARMLESS}
    streams = {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8:backslashreplace"}  # logs are read as UTF-8 on every system
    return {**kept, **(variables or {}), **streams, "PYTHONPATH": os.pathsep.join(search_path())}


def search_path() -> list[str]:
    """This process's search path without the current folder, unless gsbake itself is imported from there."""
    package, current = str(Path(__file__).resolve().parents[1]), os.path.realpath(os.getcwd())
    entries = [os.path.abspath(entry) for entry in sys.path if entry not in ("", ".")]
    kept = [entry for entry in entries if os.path.realpath(entry) != current or os.path.realpath(entry) == package]
    return kept if package in map(os.path.realpath, kept) else [package, *kept]
