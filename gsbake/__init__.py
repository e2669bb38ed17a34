"""gsbake: photos in, relightable game-ready asset out. `gsbake.run` is the command of that name as a function."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsbake.api import Result, run

__all__ = ["Result", "__version__", "run"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`run` and `Result`, imported when they are first asked for, so that importing a single step stays quick."""
    if name in ("run", "Result"):
        from gsbake import api

        return getattr(api, name)
    raise AttributeError(f"module 'gsbake' has no attribute '{name}'")
