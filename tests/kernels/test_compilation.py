"""Kernels are compiled once, in processes of their own, in the order in which they are needed."""

from __future__ import annotations

import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsbake.cli import kernels
from gsbake.config.load import load_profile
from gsbake.errors import InterruptedRun
from gsbake.kernels.compilation import Compilation, record_folder
from gsbake.pipeline.registry import Registry
from gsbake.stages import REGISTRY


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two modules with a kernel each and one that cannot be imported, on the search path; compiled code goes into a folder of its own."""
    source = tmp_path / "source"
    source.mkdir()
    for name in ("first_kernels", "second_kernels"):
        (source / f"{name}.py").write_text(textwrap.dedent("""
            from gsbake.kernels.declaration import kernel

            @kernel("f8[::1]")
            def total(values):
                return values.sum()
        """))
    (source / "broken_kernels.py").write_text("raise RuntimeError('no')\n")
    monkeypatch.syspath_prepend(str(source))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    return ["first_kernels", "second_kernels", "broken_kernels"]


def wait(compilation: Compilation, modules: list[str]) -> list[tuple[int, int]]:
    reports: list[tuple[int, int]] = []
    compilation.wait(modules, lambda: None, lambda done, total: reports.append((done, total)))
    compilation.close()
    return reports


def test_compiled_once_and_what_fails_is_left_to_its_caller(modules: list[str], tmp_path: Path) -> None:
    first = Compilation(modules, 2)
    assert first.start() == modules and first.start() == modules
    reports = wait(first, modules)
    assert reports and all(total == 3 and done < 3 for done, total in reports)
    assert len(list((tmp_path / "cache").rglob("*.nbc"))) == 2
    folder = record_folder()
    assert folder is not None and sorted(path.name for path in folder.iterdir()) == ["first_kernels", "second_kernels"]
    again = Compilation(modules, 2)
    assert not again._children and again.start() == modules[2:]
    assert wait(again, modules[:2]) == []


def test_a_stop_request_ends_the_wait(modules: list[str]) -> None:
    compilation = Compilation(modules, 1)
    compilation.start()

    def stop() -> None:
        raise InterruptedRun("x")

    with pytest.raises(InterruptedRun):
        compilation.wait(modules, stop, lambda done, total: None)
    compilation.close()
    assert all(child.returncode is not None for child in compilation._children)


class Lines:
    """Records what the display would show."""

    def __init__(self) -> None:
        self.found: list[tuple[int, int, str]] = []

    def preparing(self, done: int, total: int, text: str) -> None:
        self.found.append((done, total, text))


def session(registry: Registry = REGISTRY, profile: str = "relight") -> Any:
    engine = SimpleNamespace(registry=registry, before_stage=None)
    return SimpleNamespace(engine=engine, profile=load_profile(profile, []))


def test_a_stage_waits_for_its_own_kernels(monkeypatch: pytest.MonkeyPatch, modules: list[str]) -> None:
    monkeypatch.setenv("GSBAKE_COMPILE", "auto")
    stage = SimpleNamespace(name="first", kernels=lambda settings: modules[:1])
    other = SimpleNamespace(name="other", kernels=lambda settings: ())
    run, lines = session(SimpleNamespace(up_to=lambda target: [other, stage])), Lines()  # type: ignore[arg-type]
    with kernels.compiling(run, None, lines):
        run.engine.before_stage(other, lambda: None)
        assert lines.found == []
        run.engine.before_stage(stage, lambda: None)
        assert lines.found[0] == (0, 1, "first") and lines.found[-1] == (1, 1, "")
        lines.found.clear()
        run.engine.before_stage(stage, lambda: None)
        assert lines.found == []


def test_never(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSBAKE_COMPILE", "never")
    run = session()
    with kernels.compiling(run, None, Lines()):
        assert run.engine.before_stage is None


def test_the_fit_has_kernels_of_its_own() -> None:
    bake = REGISTRY.load("bake")
    fit, colour = (set(bake.kernels(load_profile(name, []).profile)) for name in ("relight", "preview"))
    assert colour < fit and all("materials" in name for name in fit - colour)
