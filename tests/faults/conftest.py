"""One undisturbed run that all faults are compared with."""

from __future__ import annotations

import pytest

from tests.faults.bake import Reference, undisturbed


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """The smallest relight bake, finished."""
    return undisturbed(tmp_path_factory.mktemp("faults"))
