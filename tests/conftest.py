"""What all tests share: few threads, whatever the machine has, and no writing into the checkout."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.other_systems import is_left_out

# Before any library with a thread pool is imported: the tests' own pools stay small, so that runs side by side do not fight.
for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_pool, "2")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads make each of two processes on two cores several times slower
os.environ.setdefault("GSBAKE_COMPILE", "never")  # `make test` compiles them ahead of the tests
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")  # an old TBB on the machine would only warn


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Files that need another system are not even imported."""
    return True if is_left_out(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that need another system are skipped."""
    for item in items:
        if is_left_out(item.path, getattr(item, "originalname", item.name)):
            item.add_marker(pytest.mark.skip(reason="needs another system; see tests/other_systems.py"))
