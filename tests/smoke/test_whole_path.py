"""The whole path on the built-in capture with the smallest profile, measured against the truth that wrote the capture.

The bounds are loose enough for 300 training steps at 128 pixels and tight enough to fail when a frame, a colour space or a stage is wrong.
"""

from __future__ import annotations

import html
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from gsbake.config.schema import Skip
from gsbake.gltf.read import read_glb
from gsbake.imaging.srgb import encode

#: glTF (+Y up) to the capture's Z-up world.
TO_WORLD = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def gsbake(*args: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, "-m", "gsbake", *map(str, args)], capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == code, f"exit {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The capture and the output folder of one run."""
    root = tmp_path_factory.mktemp("smoke")
    gsbake("synth", root / "capture")
    gsbake("run", root / "capture", "--profile", "smoke", "--out", root / "out")
    return root / "capture", root / "out"


def test_shape(baked: tuple[Path, Path]) -> None:
    """Chamfer distance to the true surface: below 2 % of the diagonal."""
    capture, out = baked
    truth = np.load(capture / "truth" / "points.npz")["position"]
    mesh = trimesh.load(out / "asset.glb", force="mesh", process=False)
    mesh.apply_transform(np.block([[TO_WORLD, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]))
    points = trimesh.sample.sample_surface(mesh, 30_000, seed=0)[0]
    diagonal = np.linalg.norm(np.ptp(truth, axis=0))
    there, back = cKDTree(truth).query(points)[0].mean(), cKDTree(points).query(truth)[0].mean()
    assert 50 * (there + back) / diagonal < 2.0


def test_looks(baked: tuple[Path, Path]) -> None:
    """The final asset at test photos, as the report measured it."""
    figures = json.loads(next((baked[1] / "stages" / "report").glob("*/report.json")).read_text())
    assert figures["held_out"] and figures["compared"] >= 1
    assert figures["psnr"] > 18


def test_every_rule_on_left_out_work_is_decided_and_shown(baked: tuple[Path, Path]) -> None:
    """All that this profile can meet: it matches no photos and fits no materials."""
    manifests = [json.loads(path.read_text()) for path in (baked[1] / "stages").glob("*/*/manifest.json")]
    decided = {d["what"]: d for m in manifests for d in m["decisions"] if d["what"].startswith("skip.")}
    of_the_fit = {"skip.specular", "skip.metallic_map", "skip.roughness_map"}
    assert set(decided) == {f"skip.{rule}" for rule in Skip.model_fields} - of_the_fit
    assert "MB" in decided["skip.empty_cells"]["evidence"]
    page = html.unescape(next((baked[1] / "stages" / "report").glob("*/report.html")).read_text())
    assert all(f"<code>{rule}</code>" in page and d["evidence"] in page for rule, d in decided.items())


def test_albedo(baked: tuple[Path, Path]) -> None:
    """Base colour against the true albedo, up to one gain per channel (a plain-colour profile keeps the light in it)."""
    capture, out = baked
    truth = np.load(capture / "truth" / "points.npz")
    asset = read_glb(out / "asset.glb")
    image = asset.image("base_color")
    assert image is not None
    mesh = trimesh.Trimesh(asset.attributes["POSITION"] @ TO_WORLD.T, asset.faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, 20_000, seed=1)
    weight = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    uv = (asset.attributes["TEXCOORD_0"][asset.faces[face]] * weight[:, :, None]).sum(1)
    true = encode(truth["albedo"][cKDTree(truth["position"]).query(points)[1]])
    size = np.array(image.shape[1::-1])
    x, y = np.clip((uv * size).astype(int), 0, size - 1).T
    found = np.asarray(image)[y, x, :3] / 255.0
    gain = np.median(true, 0) / np.maximum(np.median(found, 0), 1e-3)
    error = ((found * gain - true) ** 2).mean()
    assert -10 * np.log10(error) > 14
    assert np.corrcoef(found.ravel(), true.ravel())[0, 1] > 0.5


def test_second_run_is_cached(baked: tuple[Path, Path]) -> None:
    capture, out = baked
    before = (out / "asset.glb").read_bytes()
    said = json.loads(gsbake("run", capture, "--profile", "smoke", "--out", out, "--json").stdout)
    assert len(said["stages"]) == 9 and {s["status"] for s in said["stages"]} == {"cached"}
    assert (out / "asset.glb").read_bytes() == before
