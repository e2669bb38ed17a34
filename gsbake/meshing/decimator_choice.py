"""Which library decimates (`mesh.decimator`), found without importing either: the answer is part of the mesh's cache key."""

from __future__ import annotations

import importlib.util
from typing import Literal

from gsbake.errors import UsageError

Decimator = Literal["pymeshlab", "fast-simplification"]


def resolve_decimator(requested: str) -> Decimator:
    """The library that decimates, for auto|pymeshlab|fast-simplification; auto is pymeshlab where it is installed.

    Raises UsageError when pymeshlab is requested and not installed.
    """
    if requested == "fast-simplification":
        return "fast-simplification"
    if importlib.util.find_spec("pymeshlab") is not None:
        return "pymeshlab"
    if requested == "pymeshlab":
        raise UsageError("mesh.decimator is pymeshlab, which is not installed; install it, or set mesh.decimator to auto.")
    return "fast-simplification"
