"""Upper bound of materials: what a run must have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.maps import true_normals
from benchmarks.upper_bound import lay_true_maps, main
from gsbake.errors import UsageError
from gsbake.geometry.cameras import CameraSet, Similarity
from tests.support.cameras import look_at


def test_an_unfinished_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="has no finished stage ingest"):
        lay_true_maps(tmp_path / "run", tmp_path, tmp_path / "out")
    assert main([str(tmp_path / "run"), str(tmp_path), str(tmp_path / "out")]) == UsageError.exit_code
    assert "run `gsbake run` to its end first" in capsys.readouterr().err


def test_normals_of_the_reference(tmp_path: Path) -> None:
    """A ball in a turned, scaled and moved frame has the normals of its points."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=2.0)
    (tmp_path / "gt").mkdir()
    ball.export(tmp_path / "gt" / "asset.glb")
    (tmp_path / "gt" / "train.json").write_text('{"names": [], "c2w": []}')
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    to_world = Similarity(2.5, turn, np.zeros(3))
    CameraSet((look_at(np.array([4.0, 0.0, 0.0])),), to_world, "given").save(tmp_path / "cameras.json")
    points = np.random.default_rng(1).normal(size=(50, 3))
    normals = true_normals(points, tmp_path, tmp_path, tmp_path)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert (normals * directions).sum(1).min() > 0.999
