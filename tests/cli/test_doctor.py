"""`gsbake doctor`: findings and advice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from gsbake.cli import doctor


def test_advice_names_the_debian_package() -> None:
    error = "ImportError: libGL.so.1: cannot open shared object file: No such file or directory"
    assert doctor.advice_for("pymeshlab", error, installed=True) == "sudo apt-get install libgl1"
    assert "libodd.so" in doctor.advice_for("pymeshlab", "ImportError: libodd.so.3: cannot open shared object file", installed=True)
    assert doctor.advice_for("xatlas", "", installed=False).startswith("pip install xatlas")


def test_crashing_and_missing_libraries_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "crashing.py").write_text("import os; os.abort()")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(doctor, "MODULES", {"safetensors": "safetensors", "no-such-library": "no_such_library", "typer": "crashing"})
    with pytest.raises(typer.Exit) as caught:
        doctor.doctor(True, tmp_path)
    assert caught.value.exit_code == 1
    found = {f["what"]: f for f in json.loads(capsys.readouterr().out)["findings"]}
    assert found["safetensors"]["ok"] and "loads in" in found["safetensors"]["found"]
    assert not found["no-such-library"]["ok"] and found["no-such-library"]["found"] == "not installed"
    assert not found["typer"]["ok"] and "does not load" in found["typer"]["found"]
    assert found["Python"]["ok"] and "cores" in found["processor"]["found"]


def test_pymeshlab_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MODULES", {"pymeshlab": "no_such_library"})
    monkeypatch.setattr(doctor, "versions", lambda names: {"python": "3.11"})
    (finding,) = doctor.library_findings()
    assert finding.ok and "not installed" in finding.found and "fast-simplification" in finding.found
