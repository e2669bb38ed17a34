"""Ten minutes and more for the long runs of `make stress`."""

from __future__ import annotations

import pytest

from tests.fuzz.harness import INPUTS, QUICK_INPUTS


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if INPUTS > QUICK_INPUTS:
        for item in items:
            if "tests/fuzz" in item.path.as_posix():
                item.add_marker(pytest.mark.timeout(7200))
