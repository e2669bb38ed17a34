"""Ablation of the material fit: compared values, settings of the rows, and rows kept in the file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks.maps import ReferencePoints, _min_error, barycentric
from benchmarks.materials import ROW_SETTINGS, Row, main, markdown, score, truth_subset, write
from gsbake.config.load import load_profile
from gsbake.errors import UsageError
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.imaging.png import encode_png
from gsbake.imaging.srgb import decode


def square() -> GltfMesh:
    """Two triangles in the plane z = 0, from (0, 0) to (1, 1); v runs down as y runs up."""
    position = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    tangent = np.tile(np.array([1, 0, 0, 1], np.float32), (4, 1))
    uv = np.column_stack([position[:, 0], 1 - position[:, 1]]).astype(np.float32)
    return GltfMesh(position, np.tile(np.array([0, 0, 1], np.float32), (4, 1)), tangent, uv, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def test_true_values_are_sampled_at_the_point(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    base, orm = (rng.integers(0, 256, (4, 4, 3), np.uint8) for _ in range(2))
    mesh = square()
    (tmp_path / "asset.glb").write_bytes(build_glb(mesh, GltfTextures(encode_png(base), encode_png(orm), None), "square", "test"))
    points = np.array([[0.9, 0.1, 0], [0.1, 0.9, 0], [0.6, 0.4, 0]])
    face = np.array([0, 1, 0])
    share = barycentric(mesh.position[mesh.faces[face]].astype(float), points)
    asset = trimesh.load(tmp_path / "asset.glb", force="mesh", process=False)
    found = ReferencePoints(asset, face, share, np.eye(3)).values()
    at = ([3, 0, 2], [3, 0, 2])  # row from the top, column
    assert np.allclose(found[:, :3], decode(base[at] / 255), atol=1e-6)
    assert np.allclose(found[:, 3:], orm[at][:, 1:] / 255)


def test_a_global_gain_is_no_error() -> None:
    theirs = np.linspace(0.05, 0.4, 50)
    assert _min_error(1.7 * theirs, theirs) < 1e-6
    assert _min_error(theirs[::-1], theirs) > 0.01


def test_thinned_views_keep_their_reference_images(tmp_path: Path) -> None:
    truth = tmp_path / "gt"
    (truth / "ref" / "dusk").mkdir(parents=True)
    (truth / "views.json").write_text(json.dumps({"w": 2, "c2w": list(range(6))}))
    (truth / "asset.glb").write_text("the truth")
    for k in range(6):
        Image.new("L", (2, 2), k).save(truth / "ref" / "dusk" / f"{k:03d}.png")
    assert truth_subset(truth, 0, tmp_path / "none") is truth
    few = truth_subset(truth, 2, tmp_path / "few")
    assert json.loads((few / "views.json").read_text()) == {"w": 2, "c2w": [0, 3]}
    pictures = sorted((few / "ref" / "dusk").iterdir())
    assert [p.name for p in pictures] == ["000.png", "001.png"]
    assert [np.asarray(Image.open(p)).max() for p in pictures] == [0, 3]
    assert (few / "asset.glb").read_text() == "the truth"


def test_rows_replace_rows_of_the_same_key_only(tmp_path: Path) -> None:
    file = tmp_path / "materials.csv"
    write(file, [Row("cup", "relight", "fit", "", 1.0, 20.0), Row("cup", "relight", "fit", "bake.size=512", 2.0)])
    write(file, [Row("cup", "relight", "fit", "", 3.0)])
    lines = file.read_text().splitlines()[1:]
    assert [line.split(",")[3:6] for line in lines] == [["bake.size=512", "2.0", ""], ["", "3.0", ""]]
    assert markdown([Row("cup", "relight", "fit", "", 3.2, 20.04)]).splitlines()[-1] == "| cup | fit | 20.0 | – | – | – | – | – | – | 3 |"


def test_every_row_has_a_distinct_profile() -> None:
    made = [load_profile("relight", list(overrides)).profile for overrides in ROW_SETTINGS.values()]
    assert made[0].bake.materials == "surfels" and all(p.bake.materials == "fit" for p in made[1:])
    assert made[-1] == load_profile("relight").profile
    assert len({p.model_dump_json() for p in made}) == len(ROW_SETTINGS)


def test_invalid_arguments_are_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        (["cup", "--rows", "fit,fitt"], "there is no row fitt"),
        ([str(tmp_path)], "no truth to measure against"),
        (["a", "b", "--reuse", "x"], "1 finished runs for 2 captures"),
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        assert said in capsys.readouterr().err


def test_a_missing_scorer_has_no_score_and_a_failed_one_is_an_error(tmp_path: Path) -> None:
    python = tmp_path / "python"
    assert score(tmp_path / "asset.glb", True, tmp_path, tmp_path, python) == {}
    (tmp_path / "score.py").write_text("")
    python.write_text("#!/bin/sh\necho no such light >&2\nexit 1\n")
    python.chmod(0o755)
    with pytest.raises(UsageError, match="no such light"):
        score(tmp_path / "asset.glb", True, tmp_path, tmp_path, python)
