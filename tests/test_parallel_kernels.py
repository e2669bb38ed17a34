"""Kernels with parallel loops round the same when they are compiled and when they are loaded from Numba's cache."""

from __future__ import annotations

import importlib
import pkgutil

import pytest
from numba.core.dispatcher import Dispatcher

import gsbake

MODULES = [module.name for module in pkgutil.walk_packages(gsbake.__path__[:1], "gsbake.") if not module.name.endswith("__main__")]


@pytest.fixture(scope="module")
def parallel() -> dict[str, Dispatcher]:
    """{name: kernel} of all kernels with parallel loops."""
    found = {}
    for name in MODULES:
        module = importlib.import_module(name)
        for kernel in vars(module).values():
            if isinstance(kernel, Dispatcher) and kernel.targetoptions.get("parallel"):
                found[f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"] = kernel
    return found


def test_parallel_kernels_have_no_fast_math_flags(parallel: dict[str, Dispatcher]) -> None:
    """Numba optimises a parallel loop again for its cache: operations that may be reordered would then round differently."""
    assert len(parallel) > 10
    assert [name for name, kernel in parallel.items() if kernel.targetoptions.get("fastmath")] == []
