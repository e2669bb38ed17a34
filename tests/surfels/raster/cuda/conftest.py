"""Triton's interpreter for the tests of this folder, and for no others: it is chosen while Triton and the kernels are imported."""

from __future__ import annotations

import importlib.util
import os

import pytest

if importlib.util.find_spec("triton") is None:
    collect_ignore_glob = ["test_*.py"]
else:
    before = os.environ.get("TRITON_INTERPRET")
    os.environ["TRITON_INTERPRET"] = "1"
    import gsbake.surfels.raster.cuda.kernels  # noqa: F401 (imported for its effect)

    if before is None:
        del os.environ["TRITON_INTERPRET"]


@pytest.fixture(autouse=True)
def interpreter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of Triton that load at the first launch look at the variable again."""
    monkeypatch.setenv("TRITON_INTERPRET", "1")
