"""Cases of a parametrised test that `make test` leaves out and `make stress` runs, where others like them stay."""

from __future__ import annotations

from typing import Any

import pytest


def slow(*values: Any, id: str | None = None) -> Any:
    """One case, marked as slow."""
    return pytest.param(*values, id=id, marks=pytest.mark.slow)
