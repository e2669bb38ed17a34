"""The default path end to end: the built-in capture baked with `relight` (stereo, training, refinement of the mesh, material fit).

Made smaller by settings alone. Every figure is measured against the analytic truth; each bound is the mean of three runs plus a quarter of
the error. Without training, and without stereo, at least one bound is missed: so the bounds can fail.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.true_mesh import bake_on_true_mesh
from benchmarks.truth import measure_stage
from tests.support.node import gltf_issues
from tests.support.truth import Figures, measure

SMALL = (
    "train.iterations=150", "train.max_size=160", "train.init_surfels=4000", "surfels.max_count=8000", "refine.iterations=20",
    "mesh.max_resolution=128", "mesh.faces=4000", "bake.size=256", "bake.fit_size=130", "bake.fit_iterations=40", "bake.occlusion_rays=8",
    "report.views=2", "report.view_size=128",
)  # fmt: skip

#: Bounds: chamfer in % of the diagonal, angles in degrees, root mean square errors, decibels.
CHAMFER, NORMALS = 0.151, 7.1
ROUGHNESS, METALLIC = 0.303, 0.48
BASE_COLOR, RELIT = 14.8, 23.3


def gsbake(*args: object) -> None:
    done = subprocess.run([sys.executable, "-m", "gsbake", *map(str, args)], capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, f"exit {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


def settings(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The capture and the output folder of one run."""
    root = tmp_path_factory.mktemp("relight")
    gsbake("synth", root / "capture", "--views", 30, "--size", 200)
    gsbake("run", root / "capture", "--profile", "relight", "--out", root / "out", *settings(*SMALL))
    return root / "capture", root / "out"


@pytest.fixture(scope="module")
def figures(baked: tuple[Path, Path]) -> Figures:
    return measure(baked[1] / "asset.glb", baked[0])


def test_shape(figures: Figures) -> None:
    assert figures.chamfer < CHAMFER, figures
    assert figures.normals < NORMALS, figures


def test_materials(figures: Figures) -> None:
    assert figures.base_color > BASE_COLOR, figures
    assert figures.roughness < ROUGHNESS, figures
    assert figures.metallic < METALLIC, figures


def test_looks_right_in_another_light(figures: Figures) -> None:
    assert figures.relit > RELIT, figures


def test_the_asset_is_valid(baked: tuple[Path, Path]) -> None:
    assert gltf_issues(baked[1] / "asset.glb") == []


@pytest.mark.slow
def test_a_bake_on_the_true_mesh_has_its_shape(baked: tuple[Path, Path], tmp_path: Path) -> None:
    bake_on_true_mesh(baked[1], baked[0], tmp_path, overrides=("bake.materials=none", "bake.size=256", "bake.occlusion_rays=8"))
    shape = measure(tmp_path / "asset.glb", baked[0])
    assert shape.chamfer < CHAMFER / 10 and shape.normals < NORMALS / 4, shape


@pytest.mark.slow
@pytest.mark.parametrize(
    "missing", [("train.iterations=0", "refine.iterations=0"), ("stereo.enabled=never",)], ids=["no training", "no stereo"]
)
def test_bounds_are_missed_without(missing: tuple[str, ...], baked: tuple[Path, Path], figures: Figures) -> None:
    capture, out = baked
    assert figures.chamfer < CHAMFER
    gsbake("mesh", "--out", out, *settings(*missing))
    newest = max((out / "stages" / "mesh").glob("*/manifest.json"), key=lambda path: path.stat().st_mtime)
    poses = Path(json.loads(newest.read_text())["inputs"]["poses"]["path"])
    shape = measure_stage(newest.parent / "mesh.ply", poses, capture)
    assert shape.chamfer_pct > CHAMFER or shape.normal_deg > NORMALS, shape
