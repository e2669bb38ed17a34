"""Which device a run gets: what must be there for CUDA, and the sentence when it is not."""

from __future__ import annotations

import importlib.util

import pytest

from gsbake.errors import UsageError
from gsbake.pipeline import machine


def pretend(monkeypatch: pytest.MonkeyPatch, build: str | None, gpus: int, triton: bool) -> None:
    monkeypatch.setattr(machine, "torch_cuda_build", lambda: build)
    monkeypatch.setattr(machine, "cuda_devices", lambda: gpus)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if triton else None)


def test_a_usable_gpu_is_taken_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "12.8", 1, True)
    assert [machine.resolve_device(d) for d in ("auto", "cuda", "cpu")] == ["cpu", "cuda", "cpu"]


@pytest.mark.parametrize(
    ("build", "gpus", "triton", "says"),
    [(None, 1, True, "built for the CPU"), ("12.8", 0, True, "offers no GPU"), ("12.8", 1, False, "triton is not installed")],
)
def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch, build: str | None, gpus: int, triton: bool, says: str) -> None:
    pretend(monkeypatch, build, gpus, triton)
    assert machine.resolve_device("auto") == "cpu" and machine.resolve_device("cpu") == "cpu"
    with pytest.raises(UsageError, match=f"--device cuda cannot be had: .*{says}"):
        machine.resolve_device("cuda")


def test_other_names_are_refused() -> None:
    with pytest.raises(UsageError, match="auto, cpu or cuda, not 'gpu'"):
        machine.resolve_device("gpu")
