"""The doctor: advice that fits the fault, and figures in words."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from gsbake.cli import doctor
from gsbake.cli import formatting as wording


def test_advice_names_the_debian_package() -> None:
    error = "ImportError: libGL.so.1: cannot open shared object file: No such file or directory"
    assert doctor.advice_for("pymeshlab", error, installed=True) == "sudo apt-get install libgl1"
    assert "libodd.so" in doctor.advice_for("pymeshlab", "ImportError: libodd.so.3: cannot open shared object file", installed=True)
    assert doctor.advice_for("xatlas", "", installed=False).startswith("pip install xatlas")


def test_library_that_crashes_or_is_missing_is_found(
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


def test_figures_in_words() -> None:
    assert [wording.duration(s) for s in (0.32, 42.4, 185, 7620)] == ["0.3 s", "42 s", "3 min 05 s", "2 h 07 min"]
    assert [wording.size(b) for b in (480_000, 3_200_000, 1_250_000_000)] == ["480 kB", "3.2 MB", "1.25 GB"]
    assert wording.figures({"psnr": 27.1234, "faces": 30000, "log": [1], "ok": True}) == "psnr 27.12, faces 30 000, ok yes"
