"""Photos of the toy pipeline."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder with one file of three words."""
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.txt").write_text("One two three")
    return folder
