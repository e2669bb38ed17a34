"""Kernels are compiled once per installation and choice of methods, ahead of the run and with lines of their own."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsbake.cli import warm_up
from gsbake.config.load import load_profile
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.pipeline.registry import Registry
from gsbake.stages import REGISTRY


class Lines:
    """Records what the display would show."""

    def __init__(self) -> None:
        self.found: list[tuple[int, int, str]] = []

    def preparing(self, done: int, total: int, text: str) -> None:
        self.found.append((done, total, text))


def session(registry: Registry = REGISTRY, overrides: tuple[str, ...] = ()) -> Any:
    return SimpleNamespace(engine=SimpleNamespace(registry=registry), profile=load_profile("relight", list(overrides)))


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[dict[str, Any]]:
    """The small bakes that were started, without baking."""
    started: list[dict[str, Any]] = []

    def run(photos: Path, **options: Any) -> None:
        started.append(options)
        options["observer"].run_started([1, 2, 3])
        options["observer"].stage_started(SimpleNamespace(name="train"))
        options["observer"].stage_finished(None)

    monkeypatch.setattr("gsbake.api.run", run)
    monkeypatch.setattr("gsbake.synth.capture.write_capture", lambda folder, views, size: None)
    monkeypatch.setenv("GSBAKE_WARM_UP", "auto")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return started


def test_once_per_choice_of_methods(runs: list[dict[str, Any]]) -> None:
    lines = Lines()
    assert warm_up.compile_kernels(session(), None, lines)
    assert lines.found == [(0, 3, "train"), (1, 1, "")]
    assert runs[0]["settings"]["bake.materials"] == "fit" and runs[0]["until"] == "bake"
    assert not warm_up.compile_kernels(session(), None, lines) and len(runs) == 1
    assert warm_up.compile_kernels(session(overrides=("bake.materials=delight",)), None, lines) and len(runs) == 2


def test_not_for_stages_without_kernels_nor_other_pipelines(runs: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    assert not warm_up.compile_kernels(session(), "poses", Lines())
    assert not warm_up.compile_kernels(session(Registry({"stereo": "tests.toy:STEREO"})), None, Lines())
    monkeypatch.setenv("GSBAKE_WARM_UP", "never")
    assert not warm_up.compile_kernels(session(), None, Lines()) and not runs


@pytest.mark.parametrize(("error", "raised"), [(BadInputError("x"), False), (InterruptedRun("x"), True)])
def test_a_failure_is_left_to_the_run_and_a_stop_is_not(
    runs: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, error: Exception, raised: bool
) -> None:
    def fail(photos: Path, **options: Any) -> None:
        raise error

    monkeypatch.setattr("gsbake.api.run", fail)
    if raised:
        with pytest.raises(InterruptedRun):
            warm_up.compile_kernels(session(), None, Lines())
    else:
        assert not warm_up.compile_kernels(session(), None, Lines())
