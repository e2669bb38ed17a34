"""Python children: nothing from the current folder is imported, and every child is started in one way."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gsbake
from gsbake.python_process import python_command, python_environment, search_path

PACKAGE = Path(gsbake.__file__).parent


def test_a_module_in_the_current_folder_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dataclasses.py").write_text("raise SystemExit('imported from the current folder')\n")
    (tmp_path / "blake3.py").write_text("raise SystemExit('imported from the current folder')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    monkeypatch.setenv("PYTHONSTARTUP", str(tmp_path / "blake3.py"))
    command = python_command("-c", "import dataclasses, blake3, gsbake; print(gsbake.__file__)")
    done = subprocess.run(command, env=python_environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).parent.resolve() == PACKAGE.resolve()
    assert str(tmp_path) not in search_path() and "PYTHONSTARTUP" not in python_environment()
    unguarded = subprocess.run([sys.executable, "-c", "import dataclasses"], capture_output=True, text=True, timeout=60, check=False)
    assert "imported from the current folder" in unguarded.stderr  # the trap works


def test_commands_of_the_tool_in_a_folder_with_such_a_file(tmp_path: Path) -> None:
    for name in ("dataclasses", "numpy", "psutil", "json"):
        (tmp_path / f"{name}.py").write_text("import os\nos.write(2, b'imported from the current folder')\nraise SystemExit(9)\n")
    tool = Path(sys.executable).with_name("gsbake")
    if not tool.exists():
        pytest.skip("the command is not installed beside this Python")
    done = subprocess.run([tool, "doctor"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert "imported from the current folder" not in done.stdout + done.stderr
    assert "traceback" not in (done.stdout + done.stderr).lower()


def test_environment_of_the_libraries_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    environment = python_environment({"OMP_NUM_THREADS": "3"})
    assert environment["OMP_NUM_THREADS"] == "3" and environment["HOME"] == "/home/somebody"
    assert all(os.path.isabs(entry) for entry in environment["PYTHONPATH"].split(os.pathsep))


def test_nothing_else_starts_a_python() -> None:
    """`sys.executable`, shells and `os.system` appear nowhere else in the library."""
    pattern = re.compile(r"sys\.executable|shell=True|os\.system|os\.popen|os\.exec|multiprocessing|ProcessPoolExecutor")
    files = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "python_process.py"]
    lines = [(path.relative_to(PACKAGE), line.strip()) for path in files for line in path.read_text().splitlines()]
    found = [f"{path}: {line}" for path, line in lines if pattern.search(line)]
    assert found == []
