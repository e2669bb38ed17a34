"""gsbake: photos in, relightable game-ready asset out. `gsbake.run` is the command of that name as a function.

`gsbake.stages` and `gsbake.profiles` lie inside the installed package. In a source checkout their folders lie beside it, and are found
there.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsbake.api import Result, run

__all__ = ["Result", "__version__", "run"]
__version__ = "0.1.0"

if not os.path.isdir(os.path.join(__path__[0], "stages")):  # a source checkout
    __path__.append(os.path.dirname(__path__[0]))


def __getattr__(name: str) -> Any:
    """`run` and `Result`, imported when they are first asked for, so that importing a single step stays quick."""
    if name in ("run", "Result"):
        from gsbake import api

        return getattr(api, name)
    raise AttributeError(f"module 'gsbake' has no attribute '{name}'")
