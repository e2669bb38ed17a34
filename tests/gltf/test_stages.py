"""Bake and export from files to files, on a bumpy sphere whose base colour encodes the position."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import fast_simplification
import numpy as np
import pytest
import torch
import trimesh
import xatlas
from safetensors.numpy import load_file
from scipy.spatial import cKDTree

from gsbake.config.schema import Bake, Export, Scale
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from gsbake.geometry.ply import read_mesh, write_mesh
from gsbake.geometry.tangents import frame_to_world
from gsbake.gltf.export import ExportOptions, export_asset
from gsbake.gltf.lowpoly import read_lowpoly
from gsbake.gltf.read import GltfAsset, read_glb
from gsbake.imaging.exr import read_exr, write_exr
from gsbake.imaging.srgb import decode_bytes, encode_bytes
from gsbake.materials.bake import BakeOptions, bake_textures
from gsbake.monitor import SILENT, Monitor
from gsbake.shading.environment import EnvironmentLight
from gsbake.texturing.texels import rasterise
from tests.support.cameras import look_at
from tests.support.recorder import Recorder

SIZE, RADIUS, PHOTO = 256, 0.9, 240
#: Unit frame to world: half a metre of the object is one unit, turned and moved.
TO_WORLD = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 4, 5]))


def bake(folder: Path, out: Path, mesh: Path | None = None, **settings: Any) -> dict[str, Any]:
    """Bake the run in `folder` into the new folder `out`."""
    out.mkdir()
    options = BakeOptions(Bake(size=SIZE, occlusion_rays=8, **settings), holdout=0)
    return bake_textures(folder / "ingest", folder / "poses", folder / "refine", mesh or folder / "mesh", out, options)


def export(folder: Path, out: Path, monitor: Monitor = SILENT, materials: str = "none", **settings: Any) -> dict[str, Any]:
    """Export the run in `folder`, baked, into the new folder `out`."""
    out.mkdir()
    options = ExportOptions(Export(**settings), materials)
    return export_asset(*(folder / name for name in ("ingest", "poses", "refine", "bake")), out, options, monitor=monitor)


def radius(direction: np.ndarray) -> np.ndarray:
    return RADIUS * (1 + 0.015 * np.sin(9 * direction[:, 0] + 1) * np.cos(8 * direction[:, 1] + 3 * direction[:, 2]))


def colour(p: np.ndarray) -> np.ndarray:
    return 0.45 + 0.3 * p / RADIUS


def render_view(view: Camera) -> np.ndarray:
    """The smooth sphere as the camera sees it, 8-bit sRGB."""
    ray = view.rays().reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    b = ray @ view.centre
    root = b * b - (view.centre @ view.centre - RADIUS**2)
    p = view.centre + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray
    return encode_bytes(np.where(root[:, None] > 0, colour(p), 0)).reshape(PHOTO, PHOTO, 3)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    for name in ("ingest", "poses/photos", "mesh", "refine"):
        (folder / name).mkdir(parents=True)
    light, dense = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.icosphere(subdivisions=5)
    write_mesh(folder / "mesh/mesh.ply", RADIUS * light.vertices, light.faces)
    write_mesh(folder / "mesh/dense.ply", dense.vertices * radius(dense.vertices)[:, None], dense.faces)
    k = np.arange(14) + 0.5
    height, turn = 1 - 2 * k / 14, np.pi * (1 + 5**0.5) * k
    around = np.stack([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height], 1)
    cameras = tuple(look_at(3 * d, size=PHOTO, focal=300, name=f"p{i:02d}", up=(0.2, 0.1, 1.0)) for i, d in enumerate(around))
    for camera in cameras:
        cv2.imwrite(str(folder / "poses/photos" / f"{camera.name}.png"), render_view(camera)[..., ::-1])
    CameraSet(cameras, TO_WORLD, "given", metric=True).save(folder / "poses/cameras.json")
    photos = [{"name": c.name, "source": f"/somewhere/{c.name.upper()}.JPG"} for c in cameras]
    (folder / "ingest/photos.json").write_text(json.dumps({"photos": photos}))
    result = bake(folder, folder / "bake")
    assert result["unobserved_share"] < 0.01 and result["detail_share"] > 0.99
    monitor = Recorder()
    result = export(folder, folder / "export", monitor, copyright="me")
    assert monitor.warnings == [] and result["scale"] == "metres" and result["triangles"] == 1280
    return folder


@pytest.fixture(scope="module")
def asset(run: Path) -> GltfAsset:
    return read_glb(run / "export" / "asset.glb")


def unit_points(asset: GltfAsset) -> tuple[np.ndarray, Any, np.ndarray]:
    """Texels of the asset, and their points in the unit frame: glTF (x, y, z) is world (x, -z, y)."""
    uv = asset.attributes["TEXCOORD_0"]
    texels = rasterise(uv, asset.faces, SIZE)
    p = texels.interpolate(asset.attributes["POSITION"], asset.faces).astype(float)
    world = np.stack([p[:, 0], -p[:, 2], p[:, 1]], 1)
    return TO_WORLD.inverse().apply(world), texels, uv


def test_a_known_distance_makes_metres(run: Path, asset: GltfAsset, tmp_path: Path) -> None:
    """One photo shows two points of the object, whose distance is 3 m: the asset grows by as much."""
    cameras = CameraSet.load(run / "poses/cameras.json").cameras
    CameraSet(tuple(c.moved(TO_WORLD) for c in cameras)).save(tmp_path / "photo_cameras.json")
    photos = [{"name": c.name, "source": f"{c.name}.jpg", "source_width": PHOTO, "source_height": PHOTO} for c in cameras]
    (tmp_path / "photos.json").write_text(json.dumps({"photos": photos}))
    (tmp_path / "photos").symlink_to(run / "poses/photos")
    CameraSet(cameras, TO_WORLD, "solved").save(tmp_path / "cameras.json")
    camera = cameras[3]
    points = np.stack(
        [
            radius(d[None])[0] * d
            for d in (v / np.linalg.norm(v) for v in (camera.centre - 0.8 * camera.R[0], camera.centre + 0.9 * camera.R[1]))
        ]
    )
    pixels, _ = camera.project(points)
    picks = " ".join(f"{camera.name}.jpg:{x:.4f},{y:.4f}" for x, y in pixels)
    options = ExportOptions(Export(), "none", Scale(known_distances=(f"{picks} 3m",)))
    (tmp_path / "out").mkdir()
    result = export_asset(tmp_path, tmp_path, run / "refine", run / "bake", tmp_path / "out", options)
    assert result["scale"] == "metres" and 0 < result["scale_relative_error"] < 0.05
    factor = 3 / np.linalg.norm(TO_WORLD.scale * (points[0] - points[1]))
    scaled = read_glb(tmp_path / "out/asset.glb")
    extent = np.ptp(asset.attributes["POSITION"], axis=0) * factor
    assert np.allclose(np.ptp(scaled.attributes["POSITION"], axis=0), extent, rtol=5e-3)
    assert np.allclose(result["size_metres"], extent, rtol=5e-3)
    assert json.loads((tmp_path / "out/cameras.json").read_text())["scale"] == "metres"


def test_the_up_axis_turns_asset_cameras_and_light(run: Path, asset: GltfAsset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # world: about x, so glTF too
    monkeypatch.setattr("gsbake.gltf.export.measure_rotation", lambda *_, **__: quarter)
    export(run, tmp_path / "turned", up="ground")
    turned = read_glb(tmp_path / "turned/asset.glb")
    assert np.allclose(turned.attributes["POSITION"], asset.attributes["POSITION"] @ quarter.T, atol=1e-5)
    before, after = (
        np.array([f["transform_matrix"] for f in json.loads((folder / "cameras.json").read_text())["frames"]])
        for folder in (run / "export", tmp_path / "turned")
    )
    assert np.allclose(after[:, :3, :3], quarter @ before[:, :3, :3], atol=1e-6)


def test_the_front_is_the_side_of_a_photo(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "turned", front="P03.JPG", origin="centre")
    placed = read_glb(tmp_path / "turned/asset.glb").attributes["POSITION"]
    assert np.allclose((placed.min(0) + placed.max(0)) / 2, 0, atol=1e-5)
    frames = json.loads((tmp_path / "turned/cameras.json").read_text())["frames"]
    at = np.array(frames[3]["transform_matrix"])[:3, 3]
    assert abs(at[0]) < 1e-5 * np.linalg.norm(at) and at[2] > 0
    with pytest.raises(BadInputError, match=r"export.front names the photo 'z.jpg', which is none"):
        export(run, tmp_path / "none", front="z.jpg")


def test_files(run: Path) -> None:
    assert {p.name for p in (run / "bake").iterdir()} == {"mesh.safetensors", "base_color.exr", "orm.exr", "normal.exr", "coverage.exr"}
    names = {str(p.relative_to(run / "export")) for p in (run / "export").rglob("*") if p.is_file()}
    sheets = {f"previews/{name}.png" for name in ("base_color", "orm", "normal", "uv")}
    assert names == {"asset.glb", "cameras.json", "audit.json"} | sheets


def test_base_colour_is_at_its_position(asset: GltfAsset) -> None:
    p, texels, _ = unit_points(asset)
    image = asset.image("base_color")
    assert image is not None
    error = np.abs(decode_bytes(image).reshape(-1, 3)[texels.index] - colour(p))
    assert error.mean() < 0.005 and np.quantile(error, 0.99) < 0.03
    assert image.min() > 20  # no black texels, not even outside the charts


def normal_errors(asset: GltfAsset) -> np.ndarray:
    """Degrees between the true normals and those of the asset's normal map in its tangent frames, at each texel."""
    p, texels, _ = unit_points(asset)
    n = texels.interpolate(asset.attributes["NORMAL"], asset.faces)
    t = texels.interpolate(asset.attributes["TANGENT"], asset.faces)
    image = asset.image("normal")
    assert image is not None
    shaded = frame_to_world(image.reshape(-1, 3)[texels.index] / 127.5 - 1, n, t)
    direction = p / np.linalg.norm(p, axis=1, keepdims=True)
    q = direction * radius(direction)[:, None]

    def outside(x: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(x, axis=1)
        return length - radius(x / length[:, None])

    gradient = np.stack([outside(q + 1e-5 * e) - outside(q - 1e-5 * e) for e in np.eye(3)], 1) @ TO_WORLD.rotation.T
    true = np.stack([gradient[:, 0], gradient[:, 2], -gradient[:, 1]], 1)
    cosine = (shaded * true).sum(1) / np.linalg.norm(true, axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_normal_map_gives_the_true_normals_in_the_asset_frame(asset: GltfAsset) -> None:
    angle = normal_errors(asset)
    assert angle.mean() < 1.5 and np.quantile(angle, 0.99) < 4


def test_a_mesh_unwrapped_elsewhere_keeps_its_topology_and_uvs(run: Path, tmp_path: Path) -> None:
    """Decimated and unwrapped outside, edited in the frame of the asset, its charts mirrored."""
    points, faces = read_mesh(run / "mesh/dense.ply")
    points, faces = fast_simplification.simplify(points.astype(np.float32), faces, target_count=1500)
    source, corners, uv = xatlas.parametrize(points, faces)
    uv = np.where(np.arange(2) == 0, 1 - uv, uv)
    placed = TO_WORLD.apply(points[source].astype(float))
    mine = trimesh.Trimesh(
        placed @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), corners, process=False, visual=trimesh.visual.TextureVisuals(uv=uv)
    )
    mine.export(tmp_path / "mine.glb")
    to_asset = TO_WORLD.then(Similarity(1.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])))
    lowpoly = read_lowpoly(tmp_path / "mine.glb", run / "mesh/dense.ply", to_asset)
    assert lowpoly.notes == (f"{len(faces)} triangles in the frame of asset.glb", "their UVs are kept")
    folder = tmp_path / "run"
    (folder / "mesh").mkdir(parents=True)
    write_mesh(folder / "mesh/mesh.ply", *lowpoly.split())
    for name in ("ingest", "poses", "refine"):
        (folder / name).symlink_to(run / name)
    (folder / "mesh/dense.ply").symlink_to(run / "mesh/dense.ply")
    result = bake(folder, folder / "bake")
    assert result["faces"] == len(faces) and result["detail_share"] > 0.99
    monitor = Recorder()
    export(folder, folder / "export", monitor)
    assert monitor.warnings == []
    asset = read_glb(folder / "export/asset.glb")
    made, given = asset.attributes["TEXCOORD_0"][asset.faces], (uv * (1, -1) + (0, 1))[corners]
    away, which = cKDTree(given.mean(1)).query(made.mean(1))
    assert away.max() < 1e-6 and len(np.unique(which)) == len(made) == len(given)
    assert np.allclose(np.sort(made, axis=1), np.sort(given[which], axis=1), atol=1e-6)
    angle = normal_errors(asset)
    assert angle.mean() < 2 and np.quantile(angle, 0.99) < 6


def test_occlusion_only_texture_with_constant_roughness_and_metallic(run: Path, asset: GltfAsset) -> None:
    _, texels, _ = unit_points(asset)
    occlusion = asset.image("occlusion")
    assert occlusion is not None and "orm" not in asset.roles
    shown = occlusion.reshape(-1, 3)[texels.index]
    assert shown[:, 0].mean() > 245
    assert read_exr(run / "bake/coverage.exr")[..., 1].mean() > 0.4
    surface = asset.document["materials"][0]["pbrMetallicRoughness"]
    assert (surface["roughnessFactor"], surface["metallicFactor"]) == (0.8, 0.0)


def test_delighted_colours_under_the_estimated_light_match_the_photos(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "bake"
    bake(run, out, materials="delight")
    mesh = load_file(out / "mesh.safetensors")
    texels = rasterise(mesh["uv"], mesh["faces"], SIZE)
    facing, points = (texels.interpolate(mesh[name], mesh["faces"]) for name in ("normal", "position"))
    base, occlusion = (read_exr(out / name).reshape(SIZE * SIZE, 3)[texels.index] for name in ("base_color.exr", "orm.exr"))
    light = EnvironmentLight.load(out / "light.safetensors").prefilter().diffuse(torch.as_tensor(facing)).detach().numpy()
    shaded = base * light * occlusion[:, :1]
    assert np.abs(shaded - colour(points)).mean() < 0.01
    assert np.abs(base - colour(points)).mean() > 0.01


def test_cameras_look_at_the_asset(run: Path, asset: GltfAsset) -> None:
    body = json.loads((run / "export/cameras.json").read_text())
    frame = body["frames"][3]
    assert frame["file_path"] == "P03.JPG" and len(body["frames"]) == 14
    centre = asset.attributes["POSITION"].mean(0)
    matrix = np.array(frame["transform_matrix"])
    towards = centre - matrix[:3, 3]
    assert np.linalg.norm(towards) == pytest.approx(3 * TO_WORLD.scale, rel=0.01)
    assert towards @ -matrix[:3, 2] / np.linalg.norm(towards) == pytest.approx(1, abs=1e-3)


def test_trimesh_reads_the_same_surface(run: Path) -> None:
    mesh = trimesh.load(run / "export/asset.glb", force="mesh")
    assert mesh.is_winding_consistent and mesh.volume > 0
    world = np.stack([mesh.vertices[:, 0], -mesh.vertices[:, 2], mesh.vertices[:, 1]], 1)
    assert np.allclose(np.linalg.norm(TO_WORLD.inverse().apply(world), axis=1), RADIUS, atol=1e-4)
    assert len(cKDTree(mesh.vertices).query_pairs(1e-9)) == 0 or len(mesh.vertices) > 642  # cut along seams only


def test_the_same_input_gives_the_same_bytes(run: Path, tmp_path: Path) -> None:
    bake(run, tmp_path / "bake")
    assert (tmp_path / "bake/mesh.safetensors").read_bytes() == (run / "bake/mesh.safetensors").read_bytes()
    for name in ("base_color", "orm", "normal"):
        assert np.array_equal(read_exr(tmp_path / f"bake/{name}.exr"), read_exr(run / f"bake/{name}.exr"))
    export(run, tmp_path / "export", copyright="me")
    assert (tmp_path / "export/asset.glb").read_bytes() == (run / "export/asset.glb").read_bytes()


def test_an_earlier_export_is_overwritten(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "export")
    before = (tmp_path / "export/previews/base_color.png").read_bytes()
    (tmp_path / "export/previews/base_color.png").write_bytes(b"old")
    folders = (run / name for name in ("ingest", "poses", "refine", "bake"))
    export_asset(*folders, tmp_path / "export", ExportOptions(Export(), "none"))
    assert (tmp_path / "export/previews/base_color.png").read_bytes() == before


def test_an_asset_over_the_triangle_limit_fails(run: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="triangle count"):
        export(run, tmp_path / "export", max_triangles=1000)


def test_a_rough_mesh_is_repaired_and_said_to_be(run: Path, tmp_path: Path) -> None:
    """The run's mesh as loose triangles with some of them twice: the same textures, and a warning."""
    vertices, faces = read_mesh(run / "mesh/mesh.ply")
    (tmp_path / "mesh").mkdir()
    again = np.concatenate([faces, faces[:5]])
    write_mesh(tmp_path / "mesh/mesh.ply", vertices[again].reshape(-1, 3), np.arange(3 * len(again)).reshape(-1, 3))
    (tmp_path / "mesh/dense.ply").write_bytes((run / "mesh/dense.ply").read_bytes())
    monitor = Recorder()
    (tmp_path / "bake").mkdir()
    options = BakeOptions(Bake(size=SIZE, occlusion_rays=0), holdout=0, max_triangles=len(faces))
    result = bake_textures(run / "ingest", run / "poses", run / "refine", tmp_path / "mesh", tmp_path / "bake", options, monitor=monitor)
    assert result["faces"] == len(faces) and result["detail_share"] > 0.99 and result["fill"] > 0.45
    assert monitor.warnings == ["bake: the mesh was repaired; left out were 5 double faces."]
    assert monitor.line("mesh") == f"vertices joined ({3 * len(again) - len(vertices)} of {3 * len(again)} lay at the place of another)"


def test_a_mesh_over_the_triangle_limit_is_refused_before_anything_is_baked(run: Path, tmp_path: Path) -> None:
    options = BakeOptions(Bake(size=SIZE), max_triangles=1279)
    monitor = Recorder()
    with pytest.raises(BadInputError, match="the mesh has 1 280 triangles, but export.max_triangles allows 1 279; decimate it"):
        bake_textures(run / "ingest", run / "poses", run / "refine", run / "mesh", tmp_path, options, monitor=monitor)
    assert list(monitor.parts) == ["repair"]


def test_a_damaged_mesh_is_reported(run: Path, tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_bytes((run / "mesh/mesh.ply").read_bytes()[:5000])
    with pytest.raises(BadInputError, match=r"mesh\.ply"):
        bake(run, tmp_path / "bake", tmp_path)


def test_textures_are_half_floats_and_round_trip(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((5, 7, 3)).astype(np.float16)
    write_exr(tmp_path / "a.exr", image)
    assert np.array_equal(read_exr(tmp_path / "a.exr"), image.astype(np.float32))
    assert b"1970:01:01 00:00:00" in (tmp_path / "a.exr").read_bytes()  # and not the time of writing
    with pytest.raises(BadInputError, match=r"b\.exr"):
        read_exr(tmp_path / "b.exr")


class FakeRenderer:
    """Replacement of the surfel renderer: materials are functions of the position."""

    @staticmethod
    def load(folder: Path) -> FakeRenderer:
        return FakeRenderer()

    def gbuffer(self, camera: Camera) -> dict[str, np.ndarray]:
        ray = camera.rays().reshape(-1, 3)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        b = ray @ camera.centre
        root = b * b - (camera.centre @ camera.centre - RADIUS**2)
        p = camera.centre + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray
        inside = (root > 0).reshape(camera.height, camera.width)
        shape = (camera.height, camera.width)
        planes = {"albedo": colour(p).reshape(*shape, 3), "roughness": (0.5 + 0.3 * p[:, 2]).reshape(shape)}
        planes["metallic"] = (p[:, 0] > 0).reshape(shape)
        planes = {k: np.where(inside[..., None] if v.ndim == 3 else inside, v, 0).astype(np.float32) for k, v in planes.items()}
        return planes | {"alpha": inside.astype(np.float32)}


def test_materials_and_light_of_a_relightable_asset(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.texturing.photo_projection.SurfelRenderer", FakeRenderer)
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("ingest", "poses", "mesh"):
        (folder / name).symlink_to(run / name)
    (folder / "refine").mkdir()
    towards = TO_WORLD.rotation.T @ np.array([0.8, 0, 0.6])  # world +x, a little above
    light = EnvironmentLight.from_function(lambda d: np.tile(np.maximum(d @ towards, 0)[:, None] ** 40, (1, 3)) + 0.01, 32)
    light.save(folder / "refine/light.safetensors")
    bake(folder, folder / "bake", materials="surfels")
    result = export(folder, folder / "export", materials="surfels")
    assert result["audit_passed"] > 30
    asset = read_glb(folder / "export/asset.glb")
    p, texels, _ = unit_points(asset)
    orm, base = asset.image("orm"), asset.image("base_color")
    assert orm is not None and base is not None
    shown = orm.reshape(-1, 3)[texels.index] / 255
    assert np.abs(decode_bytes(base).reshape(-1, 3)[texels.index] - colour(p)).mean() < 0.005
    assert np.abs(shown[:, 1] - (0.5 + 0.3 * p[:, 2])).mean() < 0.005
    clear = np.abs(p[:, 0]) > 0.06
    assert np.abs(shown[clear, 2] - (p[clear, 0] > 0)).mean() < 0.01
    image = cv2.imread(str(folder / "export/light.hdr"), cv2.IMREAD_UNCHANGED)
    row, column = np.unravel_index(image[..., 0].argmax(), image.shape[:2])
    # three.js: u = atan2(z, x) / 2π + 1/2, v = asin(y) / π + 1/2 from the bottom; the light stands at glTF (0.8, 0.6, 0).
    assert (column + 0.5) / image.shape[1] == pytest.approx(0.5, abs=0.02)
    assert (row + 0.5) / image.shape[0] == pytest.approx(0.5 - np.arcsin(0.6) / np.pi, abs=0.02)
