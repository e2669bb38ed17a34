"""Files of targets from one bake: budgets, levels, what the files show, and other libraries that open them."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from gsbake.capture.full_photos import FullPhotos
from gsbake.config.schema import Export, Targets
from gsbake.config.targets import is_target_file
from gsbake.errors import BadInputError
from gsbake.geometry.tangents import frame_to_world
from gsbake.gltf.audit import MAX_NON_UNIT, non_unit_share
from gsbake.gltf.document import Document
from gsbake.gltf.encode import TextureMaps, quantise
from gsbake.gltf.read import read_glb
from gsbake.gltf.scene import open_scene
from gsbake.gltf.write import GltfMesh
from gsbake.imaging.encoded import decode_image
from gsbake.imaging.exr import read_exr, write_exr
from gsbake.imaging.jpeg import encode_jpeg
from gsbake.imaging.srgb import decode_bytes
from gsbake.publish import INTERNAL
from gsbake.targets.build import TargetOptions, build_targets
from gsbake.targets.images import fit_images
from gsbake.targets.maps import resized
from gsbake.texturing.texels import rasterise
from tests.support.node import gltf_issues
from tests.support.recorder import Recorder
from tests.targets.conftest import TO_WORLD, bumpy, colour

FILES = ("web", "banner", "default:ktx2+meshopt", "web:webp+quantised", "ar:usdz", "default:usdc", "planner:obj", "film", "surfels")


@pytest.fixture(scope="module")
def built(folders: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("targets")
    monitor = Recorder()
    options = TargetOptions(Targets(files=FILES, levels=1, lod_file=True), Export(copyright="me"))
    result = build_targets(folders, out, options, monitor=monitor)
    assert monitor.warnings == []
    return out, result["targets"]


def test_every_target_has_its_files(built: tuple[Path, dict[str, Any]]) -> None:
    out, figures = built
    names = {"asset_web.glb", "asset_web_lod1.glb", "asset_web_lods.glb", "asset_ktx2_meshopt.glb", "asset_web_webp_quantised.glb"}
    assert names | {"asset_ar.usdz", "asset.usdc", "asset_planner.obj", "asset_film.glb", "surfels.ply"} <= set(figures)
    assert all((out / name).stat().st_size > 0 for name in figures)
    assert json.loads((out / "targets.json").read_text()) == figures
    assert (out / "asset_film/base_color.exr").exists()
    written = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert all(is_target_file(name) for name in written if not name.endswith(INTERNAL))


@pytest.mark.parametrize("factor", [1, 8])
def test_a_finer_base_colour_stays_where_the_originals_have_its_pixels(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: int
) -> None:
    """Cameras of the asset are those of the working photos; originals have `factor` times their pixels along an edge."""
    bake = shutil.copytree(folders["bake"], tmp_path / "bake")
    image = cv2.resize(read_exr(bake / "base_color.exr"), (512, 512), interpolation=cv2.INTER_LINEAR)
    write_exr(bake / "base_color.exr", np.asarray(image, np.float32))
    camera = FullPhotos.camera
    monkeypatch.setattr(FullPhotos, "camera", lambda self, k: (c := camera(self, k)).scaled(factor * c.width, factor * c.height))
    (tmp_path / "out").mkdir()
    result = build_targets({**folders, "bake": bake}, tmp_path / "out", TargetOptions(Targets(files=("web",))))["targets"]
    assert result["asset_web.glb"]["texture_size"] == (512 if factor == 8 else 256)


def test_plain_files_pass_the_validator_without_a_message(built: tuple[Path, dict[str, Any]]) -> None:
    out, _ = built
    for path in sorted(out.glob("*.glb")):
        found = [i for i in gltf_issues(path) if i["severity"] < 2]
        if "ktx2" in path.name:  # the validator knows no KHR_texture_basisu
            found = [i for i in found if not (i["code"] == "IMAGE_UNRECOGNIZED_FORMAT" or "image/ktx2" in i["message"])]
        assert found == [], path.name


def test_budgets_are_kept(folders: dict[str, Path], tmp_path: Path) -> None:
    """A budget that the plain file exceeds: images and then triangles are reduced until it fits."""
    from gsbake.config import targets as table

    tight = table.Budget(0.05, 900, 512, 512)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(table.BUDGETS, "banner", tight)
        result = build_targets(folders, tmp_path, TargetOptions(Targets(files=("banner",))))["targets"]["asset_banner.glb"]
    assert result["bytes"] <= 50_000 and result["triangles"] <= 900
    assert read_glb(tmp_path / "asset_banner.glb").size == result["bytes"]
    assert "jpeg" in result["images"]


def test_a_mesh_that_its_seams_keep_too_large_gets_new_charts(folders: dict[str, Path], tmp_path: Path) -> None:
    """A tenth of the triangles, which the seams of the bake do not allow: the maps are carried over to new charts."""
    from gsbake.config import targets as table

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(table.BUDGETS, "banner", table.Budget(0.02, 120, 512, 512))
        result = build_targets(folders, tmp_path, TargetOptions(Targets(files=("banner",))))["targets"]["asset_banner.glb"]
    assert result["bytes"] <= 20_000 and result["triangles"] <= 120
    asset, mesh = read_glb(tmp_path / "asset_banner.glb"), as_mesh(tmp_path / "asset_banner.glb")
    base, coded = asset.image("base_color"), asset.image("normal")
    assert base is not None and coded is not None
    texels, p = unit_points(mesh, base.shape[0])
    inside = texels.inside
    # The ball of so few triangles lies up to a twentieth inside the true one, whose colours it has.
    direction = p / np.linalg.norm(p, axis=1, keepdims=True)
    error = np.abs(decode_bytes(base).reshape(-1, 3)[texels.index] - colour(direction * bumpy(direction)[:, None]))[inside]
    assert error.mean() < 0.02
    small = rasterise(mesh.uv, mesh.faces, coded.shape[0])
    n, t = (small.interpolate(values, mesh.faces) for values in (mesh.normal, mesh.tangent))
    shaded = frame_to_world(coded.reshape(-1, 3)[small.index] / 127.5 - 1, n, t)
    true = true_normals(unit_points(mesh, coded.shape[0])[1])
    assert degrees_between(shaded, true)[small.inside].mean() < 0.6 * degrees_between(n.astype(float), true)[small.inside].mean()
    assert gltf_issues(tmp_path / "asset_banner.glb") == []


def test_each_level_has_clearly_fewer_triangles_than_the_one_before(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the seams of the bake would keep them near each other."""
    monkeypatch.setattr("gsbake.targets.build.MIN_TRIANGLES", 100)
    found = build_targets(folders, tmp_path, TargetOptions(Targets(files=("banner",), levels=3)))["targets"]
    counts = [found[f"asset_banner{end}.glb"]["triangles"] for end in ("", "_lod1", "_lod2", "_lod3")]
    assert all(after <= 0.75 * before for before, after in itertools.pairwise(counts)), counts
    assert found["asset_banner_lod3.glb"]["bytes"] < 0.7 * found["asset_banner_lod1.glb"]["bytes"]


def test_a_budget_that_cannot_be_met_is_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    from gsbake.config import targets as table

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(table.BUDGETS, "banner", table.Budget(0.008, 900, 512, 512))
        with pytest.raises(BadInputError, match="file size"):
            build_targets(folders, tmp_path, TargetOptions(Targets(files=("banner",))))


def unit_points(mesh: GltfMesh | Any, size: int) -> tuple[Any, np.ndarray]:
    """Texels of a mesh in the asset's frame, and their points in the unit frame."""
    texels = rasterise(mesh.uv, mesh.faces, size)
    p = texels.interpolate(mesh.position, mesh.faces).astype(float)
    return texels, TO_WORLD.inverse().apply(np.stack([p[:, 0], -p[:, 2], p[:, 1]], 1))


def true_normals(p: np.ndarray) -> np.ndarray:
    """Normals of the bumpy ball, in the asset's frame, in the directions of points in the unit frame."""
    direction = p / np.linalg.norm(p, axis=1, keepdims=True)
    step = 1e-4
    moved = [direction + s * step * e for e in np.eye(3) for s in (1, -1)]
    radii = [bumpy(d / np.linalg.norm(d, axis=1, keepdims=True)) for d in moved]
    slope = np.stack([(radii[2 * k] - radii[2 * k + 1]) / (2 * step) for k in range(3)], 1)
    true = (direction - slope / bumpy(direction)[:, None]) @ TO_WORLD.rotation.T
    true = np.stack([true[:, 0], true[:, 2], -true[:, 1]], 1)
    return np.asarray(true / np.linalg.norm(true, axis=1, keepdims=True))


def degrees_between(normals: np.ndarray, true: np.ndarray) -> np.ndarray:
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.degrees(np.arccos(np.clip(np.einsum("nd,nd->n", unit, true), -1, 1))))


def as_mesh(path: Path) -> GltfMesh:
    asset = read_glb(path)
    keys = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0")
    return GltfMesh(*(asset.attributes[key] for key in keys), asset.faces.astype(np.int32))


@pytest.mark.parametrize("name", ["asset_web.glb", "asset_web_lod1.glb", "asset_banner_lod1.glb"])
def test_levels_show_the_same_surface(built: tuple[Path, dict[str, Any]], name: str) -> None:
    """Base colour and shaded normals of a level are those of the dense surface, though it has a quarter of the triangles."""
    out, figures = built
    asset, mesh = read_glb(out / name), as_mesh(out / name)
    assert len(mesh.faces) == figures[name]["triangles"] <= 1280
    base, coded = asset.image("base_color"), asset.image("normal")
    assert base is not None and coded is not None
    size = base.shape[0]
    texels, p = unit_points(mesh, size)
    inside = texels.inside
    error = np.abs(decode_bytes(base).reshape(-1, 3)[texels.index] - colour(p))[inside]
    assert error.mean() < 0.01
    n, t = (texels.interpolate(values, mesh.faces) for values in (mesh.normal, mesh.tangent))
    shaded = frame_to_world(coded.reshape(-1, 3)[texels.index] / 127.5 - 1, n, t)
    true = true_normals(p)

    def degrees(normals: np.ndarray) -> np.ndarray:
        return degrees_between(normals, true)[inside]

    assert degrees(shaded).mean() < 2.0
    if "lod1" in name:
        assert degrees(shaded).mean() < 0.8 * degrees(n.astype(float)).mean()  # the map adds what the mesh lacks


def test_errors_of_levels_are_written_and_grow(built: tuple[Path, dict[str, Any]]) -> None:
    out, figures = built
    errors = []
    for name in ("asset_web.glb", "asset_web_lod1.glb"):
        extras = Document.open(out / name).json["asset"]["extras"]
        assert extras["target"] == "web" and extras["scale"] == "metres"
        assert extras["error_to_dense_mesh"] == {"quantile_999": figures[name]["deviation"], "max": figures[name]["max_deviation"]}
        errors.append(figures[name]["deviation"])
    assert 0 < errors[0] < errors[1] < 0.02
    assert figures["asset_web_lod1.glb"]["triangles"] <= 640


def test_all_levels_in_one_file(built: tuple[Path, dict[str, Any]]) -> None:
    out, _ = built
    document = Document.open(out / "asset_web_lods.glb").json
    assert document["nodes"][0]["extensions"]["MSFT_lod"]["ids"] == [1]
    assert document["nodes"][0]["extras"]["MSFT_screencoverage"] == [0.5, 0.25]
    assert [len(m["primitives"]) for m in document["meshes"]] == [1, 1] and document["scenes"] == [{"nodes": [0]}]


@pytest.mark.parametrize(("name", "most"), [("asset_ktx2_meshopt.glb", 3.0), ("asset_web_webp_quantised.glb", 3.0)])
def test_compressed_files_read_back_as_the_plain_one(
    built: tuple[Path, dict[str, Any]], folders: dict[str, Path], name: str, most: float
) -> None:
    out, figures = built
    plain = folders["export"] / "asset.glb" if "ktx2" in name else out / "asset_web.glb"
    one, two = open_scene(plain), open_scene(out / name)
    assert not two.notes and figures[name]["bytes"] < plain.stat().st_size
    extent = np.ptp(one.vertices, axis=0).max()
    a, b = (np.sort(np.linalg.norm(s.vertices[s.faces].mean(1) - one.vertices.mean(0), axis=1)) for s in (one, two))
    assert len(a) == len(b) and np.abs(a - b).max() < 2e-5 * extent
    first, second = read_glb(plain), read_glb(out / name)
    for role in ("base_color", "orm", "normal"):
        pixels = [np.asarray(asset.image(role), float) for asset in (first, second)]
        assert np.sqrt(np.mean((pixels[0] - pixels[1]) ** 2)) < most, role


def test_usd_files_are_valid_and_complete(built: tuple[Path, dict[str, Any]]) -> None:
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    out, figures = built
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    for name in ("asset_ar.usdz", "asset_ar_lod1.usdz", "asset.usdc"):
        stage = Usd.Stage.Open(str(out / name))
        assert [e.GetMessage() for e in UsdValidation.ValidationContext(validators).Validate(stage)] == []
        assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh"))
        assert len(mesh.GetFaceVertexCountsAttr().Get()) == figures[name]["triangles"]
        shader = UsdShade.Shader(stage.GetPrimAtPath("/asset/material/surface"))
        assert {i.GetBaseName() for i in shader.GetInputs()} >= {"diffuseColor", "occlusion", "roughness", "metallic", "normal"}
    points = np.array(mesh.GetPointsAttr().Get())
    assert np.allclose(np.ptp(points, axis=0), np.ptp(read_glb(out / "asset_web.glb").attributes["POSITION"], axis=0), rtol=0.02)


def test_obj_opens_in_trimesh_with_its_material(built: tuple[Path, dict[str, Any]]) -> None:
    out, figures = built
    mesh: Any = trimesh.load(out / "asset_planner.obj", force="mesh")
    assert len(mesh.faces) == figures["asset_planner.obj"]["triangles"] and mesh.volume > 0
    uv, points = np.asarray(mesh.visual.uv), np.asarray(mesh.vertices)
    image = np.asarray(mesh.visual.material.image.convert("RGB"))
    row, column = ((1 - uv[:, 1]) * image.shape[0]).astype(int), (uv[:, 0] * image.shape[1]).astype(int)
    shown = decode_bytes(image)[row.clip(0, image.shape[0] - 1), column.clip(0, image.shape[1] - 1)]
    world = TO_WORLD.inverse().apply(np.stack([points[:, 0], -points[:, 2], points[:, 1]], 1))
    assert np.abs(shown - colour(world)).mean() < 0.02
    text = (out / "asset_planner.mtl").read_text()
    assert all(f"{key} asset_planner_" in text for key in ("map_Kd", "map_Pr", "map_Pm", "norm"))


def test_the_same_input_gives_the_same_bytes(folders: dict[str, Path], built: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    options = TargetOptions(Targets(files=("banner", "default:ktx2+meshopt", "ar:usdz")), Export(copyright="me"))
    build_targets(folders, tmp_path, options)
    for name in ("asset_banner.glb", "asset_ktx2_meshopt.glb", "asset_ar.usdz"):
        assert (tmp_path / name).read_bytes() == (built[0] / name).read_bytes(), name


def test_a_step_that_shortens_normals_is_passed_over() -> None:
    """Noisy normals: JPEG of low quality would fit into the bytes, and fails the audit; fewer texels at a better quality do not."""
    rng = np.random.default_rng(0)

    def maps(edge: int) -> TextureMaps:
        tilt = rng.normal(size=(128, 128, 2)).astype(np.float32)
        coarse = resized(np.dstack([0.5 * tilt, np.ones((128, 128), np.float32)]), edge)
        normal = coarse / np.linalg.norm(coarse, axis=2, keepdims=True)
        flat = np.full((edge, edge, 3), 0.5, np.float32)
        return quantise(flat, flat, 0.5 + 0.5 * normal)

    low = encode_jpeg(np.asarray(maps(128).normal), 82)
    assert non_unit_share(decode_image(low, "normal map")[..., :3]) > MAX_NON_UNIT
    budget = len(low) + 4000  # which the step of that quality keeps
    images, step, _ = fit_images(maps, 128, budget, None)
    assert images.normal is not None and step.linear[:2] == (1, "jpeg")
    assert non_unit_share(decode_image(images.normal, "normal map")[..., :3]) < MAX_NON_UNIT
    assert sum(len(image or b"") for image in (images.base_color, images.orm, images.normal)) <= budget
