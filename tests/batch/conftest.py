"""Captures of toy photos, and commands on toy stages."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cli.conftest import run

__all__ = ["run"]


@pytest.fixture
def make_capture(tmp_path: Path) -> Callable[..., Path]:
    """A capture folder with toy photos; two are too few for the toy stages."""

    def make(name: str, photos: int = 3, seed: str = "") -> Path:
        folder = tmp_path / "captures" / name / "images"
        folder.mkdir(parents=True)
        for index in range(photos):
            (folder / f"{seed}{index}.jpg").write_bytes(os.fsencode(f"{name} {index}"))
        return folder.parent

    return make
