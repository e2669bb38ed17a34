"""Other tools, replaced by scripts: arguments and resulting rows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh

import benchmarks.truth
from benchmarks import peers

CENTRES = {str(i): 4.0 * v for i, v in enumerate(np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0], [0, 0.6, 0.8], [0.8, 0, 0.6]]]))}


@pytest.fixture(autouse=True)
def _fewer_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmarks.truth, "SAMPLE_COUNT", 5_000)
    monkeypatch.setattr(benchmarks.truth, "ANCHOR_COUNT", 20_000)
    monkeypatch.setattr(benchmarks.truth, "ALIGNMENT_POINTS", (2_000, 10_000))


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A box with cameras as ground truth; `box.ply` as a tool's mesh and `cameras.json` are beside it."""
    folder = tmp_path / "capture"
    (folder / "gt").mkdir(parents=True)
    box = trimesh.creation.box((1.0, 0.7, 0.4)).subdivide()
    box.export(tmp_path / "box.ply")
    box.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).export(folder / "gt" / "asset.glb")
    poses = [np.block([[np.eye(3), v[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) for v in CENTRES.values()]
    (folder / "gt" / "train.json").write_text(json.dumps({"names": [f"{k}.png" for k in CENTRES], "c2w": [p.tolist() for p in poses]}))
    up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    frames = [{"file_path": f"{k}.png", "transform_matrix": (up @ p).tolist()} for k, p in zip(CENTRES, poses, strict=True)]
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": frames}))
    return folder


def script(path: Path, body: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)


def install_openmvs(monkeypatch: pytest.MonkeyPatch, folder: Path, mesh: Path) -> None:
    """Programs on the PATH that log their arguments and copy `mesh` to their output path."""
    leave = f'echo "$0 $*" >> calls\nfor a; do case "$last" in -o) cp {mesh} "${{a%.mvs}}.ply";; esac; last="$a"; done'
    for program in peers.OPENMVS:
        script(folder / program, leave)
    monkeypatch.setenv("PATH", str(folder), prepend=":")


def prepared(stages: Mapping[str, Path], folder: Path) -> dict[str, np.ndarray]:
    (folder / "masks").mkdir()
    (folder / "masks" / "0.mask.png").touch()
    return CENTRES


def test_openmvs_gets_a_row_for_every_mesh(tmp_path: Path, capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not peers.has_openmvs()
    install_openmvs(monkeypatch, tmp_path / "programs", tmp_path / "box.ply")
    monkeypatch.setattr(peers, "prepare_openmvs", prepared)
    assert peers.has_openmvs()
    rows = peers.run_openmvs("thing", capture, {}, 100.0, tmp_path / "out", 2)
    calls = (tmp_path / "out" / "calls").read_text().splitlines()
    assert [Path(c.split()[0]).name for c in calls] == list(peers.OPENMVS)
    assert "--mask-path masks --ignore-mask-label 0" in calls[1] and all(c.endswith("--max-threads 2") for c in calls)
    assert len(rows) == 3 and rows[0].seconds > 100 and rows == sorted(rows, key=lambda r: r.seconds)
    assert all(r.chamfer_pct is not None and r.chamfer_pct < 0.2 and r.source == "measured" for r in rows)


def test_failed_or_empty_openmvs_has_a_row_without_figures(
    tmp_path: Path, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_openmvs(monkeypatch, tmp_path / "programs", tmp_path / "box.ply")
    monkeypatch.setattr(peers, "prepare_openmvs", prepared)
    script(tmp_path / "programs" / "RefineMesh", "exit 0")
    first, second = peers.run_openmvs("thing", capture, {}, 0.0, tmp_path / "out", 0)
    assert first.chamfer_pct is not None and second.chamfer_pct is None
    script(tmp_path / "programs" / "DensifyPointCloud", "exit 3")
    (only,) = peers.run_openmvs("thing", capture, {}, 0.0, tmp_path / "out", 0)
    assert only.chamfer_pct is None and only.seconds > 0


def test_pyarchinit_is_run_where_it_is_installed(tmp_path: Path, capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "PEER", tmp_path / "peer")
    monkeypatch.setattr(peers, "SCRIPT", tmp_path / "peer_ppg.py")
    assert peers.run_pyarchinit("thing", capture, tmp_path / "out") == []
    (tmp_path / "peer_ppg.py").touch()
    times = '{"total": 50.0, "texture": 8.0}'
    bake = f'cp {capture / "gt" / "asset.glb"} {tmp_path / "cameras.json"} "$3"; echo \'{times}\' > "$3/times.json"'
    script(tmp_path / "peer" / "bin" / "python", f'test "$1" = -c && {{ echo 1.6.0; exit; }}\ntest "$PPG_GPU" = off || exit 1\n{bake}')
    (row,) = peers.run_pyarchinit("thing", capture, tmp_path / "out")
    assert (row.tool, row.seconds) == ("pyarchinit-photogrammetry 1.6.0", 42.0)
    assert row.chamfer_pct is not None and row.chamfer_pct < 0.2
    script(tmp_path / "peer" / "bin" / "python", 'test "$1" = -c && { echo 1.6.0; exit; }\nexit 1')
    (row,) = peers.run_pyarchinit("thing", capture, tmp_path / "out")
    assert row.chamfer_pct is None


def test_a_tool_beyond_the_time_limit_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "TIMEOUT_SECONDS", 0.2)
    script(tmp_path / "sleeper", "exec sleep 60")
    done, seconds = peers.run_program([tmp_path / "sleeper"], tmp_path)
    assert not done and seconds < 30
