"""Ceilings of materials: what a run must have, true maps and normals of the reference, and the rows beside which figures are printed."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks import ceiling
from benchmarks.ceiling import finished_runs, lay_true_maps, main
from benchmarks.ceiling_rows import OWN, TRUE, TRUE_NORMALS, Row, beside, ceilings, markdown, newest
from benchmarks.csv_rows import write_rows
from benchmarks.lab import fits
from benchmarks.maps import ReferencePoints
from benchmarks.materials import Row as PartRow
from benchmarks.objects.__main__ import Row as ObjectRow
from benchmarks.skip import write
from gsbake.errors import UsageError
from gsbake.geometry.cameras import CameraSet, Similarity
from tests.support.cameras import look_at

ROW = Row("toy", OWN, 0, "abc1234", 0.05, 3.0, 25.0, 26.0, 23.0, 24.0, 0.1, 0.2, "2026-11-28")


def test_an_unfinished_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="has no finished stage ingest"):
        lay_true_maps(tmp_path / "run", tmp_path, tmp_path / "out")
    with pytest.raises(SystemExit):
        main([str(tmp_path)])
    assert "has no finished run of any object" in capsys.readouterr().err


def test_the_newest_finished_run_counts(tmp_path: Path) -> None:
    """Runs without an asset or without a capture do not."""
    for name, run in (("toy", "a"), ("toy", "b"), ("vase", "a"), ("stool", "a")):
        (tmp_path / "runs" / run / name).mkdir(parents=True)
        if name != "stool":
            (tmp_path / "runs" / run / name / "asset.glb").touch()
    for name in ("toy", "stool"):
        (tmp_path / "captures" / name / "gt").mkdir(parents=True)
        (tmp_path / "captures" / name / "gt" / "views.json").touch()
    os.utime(tmp_path / "runs" / "b" / "toy" / "asset.glb", (1, 1))
    assert finished_runs(tmp_path) == {"toy": tmp_path / "runs" / "a" / "toy"}


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
    normals = ReferencePoints.nearest_to(points, tmp_path, tmp_path, tmp_path).normals()
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert (normals * directions).sum(1).min() > 0.999


@pytest.mark.parametrize("mirrored", [False, True])
def test_normal_map_and_emission_of_the_reference(mirrored: bool) -> None:
    """A square that looks up (+Y of glTF) with u along x, or against it: red leans along u, green against the image's rows."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, -1], [0, 0, -1]])
    uv = np.column_stack([1 - corners[:, 0] if mirrored else corners[:, 0], -corners[:, 2]])
    lean = np.array([0.48, 0.36, 0.8])
    image = Image.fromarray(np.tile(np.round(255 * (lean + 1) / 2).astype(np.uint8), (2, 2, 1)))
    glow = Image.fromarray(np.full((2, 2, 3), 255, np.uint8))
    material = trimesh.visual.material.PBRMaterial(normalTexture=image, emissiveTexture=glow, emissiveFactor=[1.0, 0.5, 0.25])
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    square = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], vertex_normals=np.tile([0.0, 1, 0], (4, 1)), visual=visual, process=False)
    found = ReferencePoints(square, np.array([0, 1]), np.full((2, 3), 1 / 3), np.eye(3))
    z_up = [-0.48 if mirrored else 0.48, 0.36, 0.8]
    np.testing.assert_allclose(found.normals(), np.tile(z_up, (2, 1)), atol=0.01)
    np.testing.assert_allclose(found.emission(), np.tile([1.0, 0.5, 0.25], (2, 1)))
    material.emissiveFactor = None
    assert found.emission() is None


def test_every_object_is_scored_with_three_kinds_of_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that fails is named and the others are measured."""
    for name in ("toy", "vase"):
        (tmp_path / "runs" / "a" / name).mkdir(parents=True)
        (tmp_path / "runs" / "a" / name / "asset.glb").touch()
        (tmp_path / "captures" / name / "gt").mkdir(parents=True)
        (tmp_path / "captures" / name / "gt" / "views.json").write_text(json.dumps({"c2w": []}))
    scored = []

    def lay(run: Path, capture: Path, out: Path) -> dict[str, Path]:
        if run.name == "vase":
            raise UsageError("no materials")
        return {TRUE: out / "true.glb", TRUE_NORMALS: out / "normals.glb"}

    def score(capture: Path, asset: Path, cameras: Path | None, scorer: Path) -> dict[str, float]:
        scored.append((asset.name, cameras))
        return dict.fromkeys(ceiling.FIGURES.values(), float(len(scored)))

    monkeypatch.setattr(ceiling, "lay_true_maps", lay)
    monkeypatch.setattr(ceiling, "score", score)
    (tmp_path / "score.py").touch()
    monkeypatch.setattr(ceiling, "PYTHON", tmp_path / "score.py")
    file = tmp_path / "ceiling.csv"
    assert main([str(tmp_path), "--scorer", str(tmp_path), "--csv", str(file)]) == 1
    cameras = tmp_path / "runs" / "a" / "toy" / "cameras.json"
    assert scored == [("asset.glb", cameras), ("true.glb", cameras), ("normals.glb", cameras)]
    assert {maps: row.relit for maps, row in newest("toy", file).items()} == {OWN: 1.0, TRUE: 2.0, TRUE_NORMALS: 3.0}
    shown = capsys.readouterr()
    assert (
        "vase: no materials" in shown.err
        and "| toy | 1.000 | 1.0 | 1.0 (1.0) | 2.0 (2.0) | 3.0 (3.0) | 1.0 (1.0) | 2.0 (2.0) |" in shown.out
    )


def test_a_ceiling_holds_for_its_mesh(tmp_path: Path) -> None:
    """Rows of another shape are no ceiling; of several the newest counts; a figure without one stands alone."""
    file, true = tmp_path / "ceiling.csv", replace(ROW, maps=TRUE, relit=30.0, commit="def5678")
    write_rows(file, [ROW, replace(true, relit=28.0, date="2026-11-27", commit="old"), true])
    found = ceilings("toy", 0.0505, file)
    assert found[TRUE] == true and not ceilings("toy", 0.06, file) and not ceilings("vase", 0.05, file)
    assert beside(25.04, found[TRUE], "relit", 1) == "25.0/30.0" and beside(25.04, None, "relit", 1) == "25.0"
    assert markdown([ROW]).splitlines()[-1] == "| toy | 0.050 | 3.0 | 25.0 (26.0) | – | – | 23.0 (24.0) | – |"


def test_tables_print_figures_beside_their_ceilings(tmp_path: Path) -> None:
    """An object with a ceiling, one whose mesh has changed, and parts of the fit, which are scored on three views."""
    shape = "relight", "", 0, "abc1234", "cpu", 100.0
    figures = 25.0, 26.0, 23.0, 24.0, 0.1, 0.2, "1.00 1.00 1.00", "2026-11-28"
    objects = [ObjectRow("toy", "none", *shape, 0.05, 3.0, *figures), ObjectRow("vase", "none", *shape, 0.2, 3.0, *figures)]
    true = replace(ROW, maps=TRUE, relit=30.0, relit_scaled=31.0, base=28.0, base_scaled=29.0, roughness=0.01, metallic=0.02)
    normals = replace(true, maps=TRUE_NORMALS, relit=33.0, relit_scaled=34.0)
    write_rows(tmp_path / "objects.csv", objects)
    write_rows(
        tmp_path / "ceiling.csv", [ROW, true, normals, replace(true, object="vase"), replace(true, object="box", views=3, relit=40.0)]
    )
    write(tmp_path / "materials.csv", [PartRow("box", "relight", "projected", "", 50.0, 20.0)], 3)
    toy, vase, median = fits.objects(tmp_path).rows
    assert toy[3:] == ["25.0/30.0 (26.0/31.0)", "33.0 (34.0)", "23.0/28.0 (24.0/29.0)", "0.100/0.010", "0.200/0.020"]
    assert vase[3:5] == median[3:5] == ["25.0 (26.0)", "–"]
    assert fits.parts(tmp_path).rows[1] == ["", "true maps, newest mesh", "–", "40.0 (31.0)", "29.0", "0.010", "0.020", "–"]
