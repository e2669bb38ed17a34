"""Device selection: the requirements of CUDA, and the error when one is missing."""

from __future__ import annotations

import importlib.util

import pytest

from gsbake.errors import UsageError
from gsbake.pipeline import machine


def fake_machine(monkeypatch: pytest.MonkeyPatch, build: str | None, gpus: int, triton: bool) -> None:
    monkeypatch.setattr(machine, "torch_cuda_build", lambda: build)
    monkeypatch.setattr(machine, "cuda_devices", lambda: gpus)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if triton else None)


def test_cuda_is_used_on_request_only(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_machine(monkeypatch, "12.8", 1, True)
    assert [machine.resolve_device(d) for d in ("auto", "cuda", "cpu")] == ["cpu", "cuda", "cpu"]


@pytest.mark.parametrize(
    ("build", "gpus", "triton", "message"),
    [(None, 1, True, "built for the CPU"), ("12.8", 0, True, "reports no GPU"), ("12.8", 1, False, "triton is not installed")],
)
def test_error_names_the_missing_requirement(
    monkeypatch: pytest.MonkeyPatch, build: str | None, gpus: int, triton: bool, message: str
) -> None:
    fake_machine(monkeypatch, build, gpus, triton)
    assert machine.resolve_device("auto") == "cpu" and machine.resolve_device("cpu") == "cpu"
    with pytest.raises(UsageError, match=f"--device cuda is not available: .*{message}"):
        machine.resolve_device("cuda")


def test_unknown_device_raises() -> None:
    with pytest.raises(UsageError, match="auto, cpu or cuda, not 'gpu'"):
        machine.resolve_device("gpu")
