"""`make setup` and `make clean` delete nothing that they did not make. No package is installed: the Python that they get fails."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """A Python that is new enough, begins an environment, and fails."""
    tool = tmp_path / "python"
    tool.write_text('#!/bin/sh\ncase "$1" in -c) exit 0;; esac\nmkdir -p "$3/lib" && echo made > "$3/pyvenv.cfg"\nexit 1\n')
    tool.chmod(0o755)
    return tool


def make(*words: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = ["make", "--no-print-directory", "-f", str(ROOT / "Makefile"), *map(str, words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, timeout=60)


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() if path.is_file() else "" for path in folder.rglob("*")}


def test_setup_that_fails_removes_what_it_made(tmp_path: Path, python: Path) -> None:
    done = make(f"VENV={tmp_path / 'new'}", f"PYTHON={python}", "setup")
    assert done.returncode and "cannot make a virtual environment" in done.stderr and not (tmp_path / "new").exists()


@pytest.mark.parametrize("what", ["thesis", "file", "empty", "environment", "link"])
def test_setup_that_fails_leaves_what_was_there(tmp_path: Path, python: Path, what: str) -> None:
    home, folder = tmp_path / "home", tmp_path / "home" / "dir"
    home.mkdir()
    if what == "file":
        folder.write_text("mine")
    elif what == "link":
        (home / "target").mkdir()
        (home / "target" / "thesis.odt").write_text("mine")
        folder.symlink_to(home / "target")
    else:
        folder.mkdir()
        if what != "empty":
            (folder / "thesis.odt").write_text("mine")
        if what == "environment":
            (folder / "pyvenv.cfg").write_text("made\n")
    before = contents(home)
    done = make(f"VENV={folder}", f"PYTHON={python}", "setup")
    assert done.returncode and contents(home).items() >= before.items() and folder.exists()
    if what in ("thesis", "file", "link"):
        assert contents(home) == before and f"{folder} is no virtual environment" in done.stderr


def test_clean_deletes_environments_only(tmp_path: Path) -> None:
    for name in ("gsbake", "stages", "profiles", "tests", "benchmarks", "mine", ".score", ".audit"):
        (tmp_path / name).mkdir()
    for name in ("mine/thesis.odt", ".score/music.mid", ".audit/pyvenv.cfg", "constraints.txt"):
        (tmp_path / name).write_text("torch==1")
    done = make("VENV=mine", "clean", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "mine" / "thesis.odt").is_file() and (tmp_path / ".score" / "music.mid").is_file()
    assert "mine is no virtual environment and stays" in done.stderr and not (tmp_path / ".audit").exists()
