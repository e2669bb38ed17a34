"""glTF files of other programs, as fixtures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.gltf_files import two_triangles, write_ball


@pytest.fixture
def gltf(tmp_path: Path) -> Path:
    """The .gltf file of `two_triangles`."""
    path = tmp_path / "two.gltf"
    path.write_text(json.dumps(two_triangles()))
    return path


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A green ball."""
    return write_ball(tmp_path_factory.mktemp("ball") / "ball.glb", (40, 160, 60))
