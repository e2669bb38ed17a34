"""Marks the long runs of `make stress`, which take more than the usual time limit."""

from __future__ import annotations

import pytest

from tests.fuzz.harness import INPUTS, QUICK_INPUTS


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Before pytest selects by mark: a long run belongs to the stress tests, a quick one to the quick tests."""
    if INPUTS > QUICK_INPUTS:
        for item in items:
            if "tests/fuzz" in item.path.as_posix():
                item.add_marker(pytest.mark.stress)
                item.add_marker(pytest.mark.timeout(7200))
