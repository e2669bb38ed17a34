"""Objects with known materials: textures hold what the procedures define, the list is complete, rows are kept."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks.csv_rows import read_rows, write_rows
from benchmarks.objects import fine
from benchmarks.objects.__main__ import Row, markdown
from benchmarks.objects.entries import read_entries
from benchmarks.objects.fine_render import FINE_MODELS, Z_UP, render_fine
from benchmarks.objects.gauge import DIAL, ROTATION, gauge, gauge_material
from benchmarks.objects.models import MODELS, model_glb
from benchmarks.objects.parts import Material, turned
from gsbake.errors import BadInputError
from gsbake.imaging.srgb import decode
from gsbake.report.asset import open_asset


def test_textures_hold_the_material_of_each_position() -> None:
    """A short cylinder: copper above, rough green below, a lamp at the top."""

    def procedure(p: np.ndarray) -> Material:
        copper = Material.uniform(len(p), (0.9, 0.6, 0.5), 0.3, 1.0)
        green = Material.uniform(len(p), (0.1, 0.4, 0.2), 0.8)
        lamp = Material(np.full((len(p), 3), 0.02), np.full(len(p), 0.5), np.zeros(len(p)), np.tile([0.0, 0.5, 1.0], (len(p), 1)))
        return copper.blend(green, (p[:, 2] < 0.5).astype(float)).blend(lamp, (p[:, 2] > 0.9).astype(float))

    glb = model_glb(trimesh.creation.cylinder(0.5, segment=[[0, 0, 0], [0, 0, 1]], sections=24).subdivide().subdivide(), procedure, 256)
    mesh = trimesh.load(io.BytesIO(glb), file_type="glb", force="mesh", process=False)
    height = np.asarray(mesh.vertices)[:, 1]  # +Y up
    assert height.min() == pytest.approx(0, abs=1e-6) and height.max() == pytest.approx(1, abs=1e-6)
    material = mesh.visual.material
    base, orm, emission = (np.asarray(image.convert("RGB")) / 255 for image in (
        material.baseColorTexture, material.metallicRoughnessTexture, material.emissiveTexture))  # fmt: skip
    centre, uv = mesh.triangles_center[:, 1], np.asarray(mesh.visual.uv)[mesh.faces].mean(1)
    row, column = ((1 - uv[:, 1]) * 256).astype(int), (uv[:, 0] * 256).astype(int)
    side = np.abs(mesh.face_normals[:, 1]) < 0.1
    upper, lower, top = side & (centre > 0.55) & (centre < 0.85), side & (centre < 0.45), centre > 0.99
    assert upper.sum() > 20 and lower.sum() > 20 and top.sum() > 20
    np.testing.assert_allclose(decode(base[row, column][upper]), np.tile([0.9, 0.6, 0.5], (upper.sum(), 1)), atol=0.01)
    np.testing.assert_allclose(orm[row, column][upper, 1:], np.tile([0.3, 1.0], (upper.sum(), 1)), atol=0.005)
    np.testing.assert_allclose(orm[row, column][lower, 1:], np.tile([0.8, 0.0], (lower.sum(), 1)), atol=0.005)
    np.testing.assert_allclose(decode(emission[row, column][top]), np.tile([0.0, 0.5, 1.0], (top.sum(), 1)), atol=0.01)


@pytest.mark.parametrize("name", MODELS)
def test_models_have_valid_materials(name: str) -> None:
    shape, procedure = MODELS[name]
    mesh = shape()
    points = np.asarray(mesh.vertices)[:: max(1, len(mesh.vertices) // 2000)]
    material = procedure(points)
    assert material.base.shape == (len(points), 3) and material.base.min() >= 0 and material.base.max() <= 1
    assert material.roughness.min() >= 0.05 and material.roughness.max() <= 1
    assert material.metallic.min() >= 0 and material.metallic.max() <= 1
    assert mesh.is_winding_consistent and mesh.volume > 0


def test_turned_surfaces_have_exact_normals() -> None:
    """A cylinder with one rounded edge: straight legs are flat, and the arc has its radius and centre."""
    mesh = turned([(0, 0, 0), (1, 0, 0), (1, 2, 0.3), (0, 2, 0)], sections=32)
    normals, vertices = np.asarray(mesh.vertex_normals), np.asarray(mesh.vertices)
    used = np.unique(mesh.faces)
    radius, height = np.hypot(vertices[used, 0], vertices[used, 1]), vertices[used, 2]
    arc = height > 1.7
    outward = np.column_stack([vertices[used, :2] / np.maximum(radius, 1e-9)[:, None] * (radius - 0.7)[:, None], height - 1.7]) / 0.3
    on_arc = arc & (radius > 0.7)
    np.testing.assert_allclose(normals[used][on_arc], outward[on_arc], atol=1e-9)
    cosine = (normals[mesh.faces].mean(1) * mesh.face_normals).sum(1)
    assert on_arc.sum() >= 8 * 32 and cosine.min() > 0.97
    assert trimesh.Trimesh(vertices, mesh.faces, process=True).is_watertight


def test_fine_noise_has_detail_of_a_few_texels() -> None:
    """Unit variance; places a texel (.001) apart differ by a twentieth of it or more, distant ones entirely."""
    points = np.random.default_rng(3).uniform(-1, 1, (20_000, 3))
    here, beside, away = (fine.grain(points + [offset, 0, 0], 5) for offset in (0.0, 0.001, 0.5))
    assert here.std() == pytest.approx(1, abs=0.1)
    assert 0.05 < (beside - here).std() < 0.5 and abs(np.corrcoef(here, away)[0, 1]) < 0.1
    cell = fine.lattice(points, 0.003, 5)
    np.testing.assert_allclose(fine.lattice(points + 0.003 * fine.CUBE, 0.003, 5), cell, atol=1e-6)
    assert cell.std() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("name", FINE_MODELS)
def test_fine_renders_have_their_true_colour(name: str, tmp_path: Path) -> None:
    """The object fills the photo, a camera looks at its centre, and colours are those of the material at the places that rays hit."""
    capture = render_fine(name, tmp_path, views=2, size=64, texture=512)
    poses = json.loads((capture / "transforms.json").read_text(encoding="utf-8"))
    asset = open_asset(capture / "gt" / "asset.glb")
    low, high = asset.position.min(0), asset.position.max(0)
    pose, focal = np.array(poses["frames"][1]["transform_matrix"]), poses["fl_x"]
    centre = np.linalg.inv(pose) @ [*(Z_UP @ (low + high) / 2), 1]
    assert np.abs(centre[:2]).max() < 1e-9 and centre[2] < 0
    photo, base = (np.asarray(Image.open(capture / folder / "0001.png")) for folder in ("images", "gt/base_color"))
    rows, columns = np.nonzero(base[..., 3] == 255)
    assert 0.2 < len(rows) / 64**2 < 0.9 and np.array_equal(photo[..., 3], base[..., 3])
    shape, procedure = FINE_MODELS[name]
    mesh, keep = shape(), slice(None, None, 7)
    rays = np.column_stack([columns[keep] + 0.5 - 32, 32 - rows[keep] - 0.5, np.full(len(rows[keep]), -focal)]) @ pose[:3, :3].T
    place, ray, _ = mesh.ray.intersects_location(np.tile(pose[:3, 3], (len(rays), 1)), rays, multiple_hits=False)
    true, found = procedure(np.asarray(place)).base.mean(1), decode(base[rows, columns, :3] / 255)[keep][ray].mean(1)
    assert len(ray) > 50 and np.corrcoef(true, found)[0, 1] > 0.3 and abs(np.log(true.mean() / found.mean())) < 0.1
    shaded = decode(photo[rows, columns, :3] / 255)
    assert 0.2 < shaded.mean() / decode(base[rows, columns, :3] / 255).mean() < 5


def test_ink_covers_a_part_of_the_sheet() -> None:
    ink = fine.sheet()
    assert ink.shape == fine.SHEET[::-1] and 0.1 < ink.mean() < 0.5


@pytest.mark.parametrize("name", ["mug", "bowl", "flower_pot", "box", "shoe"])
def test_hollows_are_open(name: str) -> None:
    """A ray from above ends deep in the object, on a surface that looks up."""
    mesh = MODELS[name][0]()
    low, high = mesh.bounds
    start = np.array([[-0.55 if name == "shoe" else 0.0, 0.01, high[2] + 1]])
    place, _, face = mesh.ray.intersects_location(start, [[0, 0, -1.0]])
    first = int(np.argmax(place[:, 2]))
    assert place[first, 2] < low[2] + 0.25 * (high[2] - low[2]) and mesh.face_normals[face[first], 2] > 0.9


def test_the_dial_is_printed_and_set_back() -> None:
    """Zero is marked black, paper is bright and glossy, the hub black; the metal rim stands .13 before the dial."""
    zero = np.radians(225)
    own = np.array(
        [[0.78 * 0.57 * np.cos(zero), 0.78 * 0.57 * np.sin(zero), DIAL], [0.2, 0.0, DIAL], [0.64, 0, 0.42], [0, 0.02, DIAL + 0.05]]
    )
    material = gauge_material(own @ ROTATION.T)
    assert material.base[0].max() < 0.05 and material.base[1].min() > 0.6 and material.base[3].max() < 0.05
    assert material.roughness[1] == pytest.approx(0.12) and material.metallic.tolist() == [0, 0, 1, 0]
    mesh = gauge()
    front = (np.asarray(mesh.vertices) @ ROTATION)[:, 2].max()
    assert front - DIAL == pytest.approx(0.13, abs=1e-6)


def test_the_list_is_complete_and_reproducible(tmp_path: Path) -> None:
    """Ten objects with the kinds of material that the fit must tell apart; what the photos depend on is in the key of a render."""
    entries = read_entries()
    assert len(entries) >= 10
    metals = [entry.metal for entry in entries.values()]
    assert metals.count("neutral") + metals.count("coloured") >= 3 and metals.count("none") >= 3
    assert all(entry.model in MODELS or entry.sha256 for entry in entries.values())
    vase = entries["brass_vase"]
    assert replace(vase, seed=1).key != vase.key and replace(vase, light="forest").key != vase.key
    assert replace(vase, licence="other").key == vase.key
    (tmp_path / "assets").mkdir()
    (tmp_path / vase.model).write_bytes(b"another file")
    with pytest.raises(BadInputError, match="SHA-256"):
        vase.model_bytes(tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [('colour = "red"', "unknown key colour"), ('relight = ["city", "forest"]', "relit by the light of its photos"), ("", "not complete")],
)
def test_wrong_entries_are_named(tmp_path: Path, line: str, message: str) -> None:
    """A key that is not known, an object relit by the light of its photos, and a missing key."""
    listed = tmp_path / "objects.toml"
    defaults = 'mode = "posed"\nviews = 4\nresolution = [8, 8]\nsamples = 1\ntest_views = 1\ntest_resolution = 8\nseed = 0\n'
    own = 'model = "toy"\nlight = "city"\n' + ("" if message == "not complete" else 'metal = "none"\n')
    own += line if line.startswith("relight") else f'relight = ["forest"]\n{line}'
    listed.write_text(f"[defaults]\n{defaults}[objects.thing]\n{own}\n")
    with pytest.raises(BadInputError, match=message):
        read_entries(listed)


def row(name: str, relit: float, commit: str = "a") -> Row:
    return Row(name, "none", "relight", "", 0, commit, "cpu", 100.0, 0.1, 5.0, relit, relit + 1, 20.0, 21.0, 0.1, 0.2, "1.00 1.10 0.90")


def test_rows_survive_the_file_and_replace_their_like(tmp_path: Path) -> None:
    """A measured row replaces that of the same object and commit, and no other."""
    path = tmp_path / "rows.csv"
    write_rows(path, [row("toy", 20.0), row("vase", 22.0), row("toy", 24.0, "b"), row("toy", 26.0)])
    found = read_rows(path, Row)
    assert sorted((r.object, r.commit, r.relit) for r in found) == [("toy", "a", 26.0), ("toy", "b", 24.0), ("vase", "a", 22.0)]
    assert found[0].seed == 0 and found[0].gains == "1.00 1.10 0.90"


def test_the_table_ends_with_medians() -> None:
    """Three objects: the middle one's figure, not the mean."""
    last = markdown([row("a", 10.0), row("b", 20.0), row("c", 60.0)]).splitlines()[-1]
    assert "**median**" in last and "20.0 (21.0)" in last
