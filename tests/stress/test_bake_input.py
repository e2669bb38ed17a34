"""Baking, material fit, light search and export on hostile meshes, photos, cameras and textures: a finite asset, or a sentence."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from gsbake.config.schema import Bake, Export
from gsbake.errors import GsbakeError
from gsbake.geometry.cameras import Similarity
from gsbake.geometry.ply import write_mesh
from gsbake.gltf.export import ExportOptions, export_asset
from gsbake.gltf.read import read_glb
from gsbake.imaging.exr import read_exr, write_exr
from gsbake.materials.bake import BakeOptions, bake_textures
from gsbake.materials.light_intensity import adjust_radiance, search_light
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.materials.remaining_shading import find_irradiance, remove_shading
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from tests.stress.captures import CAMERAS, MASKS, PHOTOS, masks, photos, write
from tests.stress.meshes import MESHES
from tests.support.linear import linear
from tests.support.recorder import Recorder

SIZE = 128


def bake(folder: Path, mesh: str, cameras: str, pictures: str, outlines: str, to_world: Similarity | None = None, **settings: Any) -> bool:
    """Bake a hostile input into `folder`/bake and check what was written; False where it was refused by a sentence."""
    views = CAMERAS[cameras]()
    write(folder / "poses", views, photos(pictures, len(views)), masks(outlines, len(views)), to_world)
    for name in ("refine", "mesh", "bake", "ingest"):
        (folder / name).mkdir()
    for name in ("mesh.ply", "dense.ply"):
        write_mesh(folder / "mesh" / name, *MESHES[mesh]())
    (folder / "ingest/photos.json").write_text(json.dumps({"photos": [{"name": v.name, "source": f"{v.name}.jpg"} for v in views]}))
    options = BakeOptions(Bake(**{"size": SIZE, "occlusion_rays": 4, "fit_iterations": 8, "fit_size": 64} | settings), light_size=8)
    try:
        ingest, poses, surfels, meshes = (folder / stage for stage in ("ingest", "poses", "refine", "mesh"))
        results = bake_textures(ingest, poses, surfels, meshes, folder / "bake", options, monitor=Recorder())
    except GsbakeError as error:
        assert str(error).startswith("bake: ") or "mesh" in str(error)
        return False
    assert np.isfinite([value for value in results.values() if isinstance(value, float | int)]).all()
    for path in (folder / "bake").glob("*.exr"):
        image = read_exr(path)
        assert np.isfinite(image).all() and image.min() >= 0, path.name
    arrays = load_file(folder / "bake" / "mesh.safetensors")
    assert all(np.isfinite(array).all() for array in arrays.values())
    if (folder / "bake" / "light.safetensors").exists():
        assert np.isfinite(EnvironmentLight.load(folder / "bake" / "light.safetensors").radiance().detach().numpy()).all()
    return True


def export(folder: Path, materials: str = "none") -> bool:
    """Export what was baked and check the asset; False where it was refused."""
    out = folder / "export"
    out.mkdir()
    options = ExportOptions(Export(), materials)
    names = (folder / name for name in ("ingest", "poses", "refine", "bake"))
    try:
        results = export_asset(*names, out, options, monitor=Recorder())
    except GsbakeError as error:
        assert "export" in str(error) or "bake again" in str(error).lower()
        return False
    assert results["triangles"] > 0
    asset = read_glb(out / "asset.glb")
    assert all(np.isfinite(values).all() for values in asset.attributes.values())
    json.loads((out / "cameras.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} in cameras.json"))
    return True


#: Every kind of mesh, cameras, photos and masks with plain others.
PLAIN = ("open", "plain", "noise", "disc")
CASES = [
    *((mesh, *PLAIN[1:]) for mesh in MESHES),
    *((PLAIN[0], cameras, *PLAIN[2:]) for cameras in CAMERAS if cameras != "plain"),
    *((*PLAIN[:2], kind, PLAIN[3]) for kind in PHOTOS[1:]),
    *((*PLAIN[:3], kind) for kind in MASKS[1:]),
]


#: The others are in the long tests.
QUICK = [case for case in CASES if case[1] in ("plain", "looking away", "on the surface") and case[3] in ("disc", "none", "one pixel")]


@pytest.mark.parametrize(("mesh", "cameras", "pictures", "outlines"), QUICK)
def test_projection_and_export_are_finite(tmp_path: Path, mesh: str, cameras: str, pictures: str, outlines: str) -> None:
    if bake(tmp_path, mesh, cameras, pictures, outlines):
        export(tmp_path)


@pytest.mark.parametrize(("pictures", "materials"), [("black", "fit"), ("black", "delight"), ("noise", "delight")])
def test_materials_are_finite(tmp_path: Path, pictures: str, materials: str) -> None:
    """Few, as a fit takes seconds; the others are in the long tests."""
    assert bake(tmp_path, *PLAIN[:2], pictures, "disc", materials=materials, fit_size=64, fit_iterations=5)
    assert export(tmp_path, materials)


@pytest.mark.stress
@pytest.mark.parametrize(("mesh", "cameras", "pictures", "outlines"), CASES)
@pytest.mark.parametrize(
    "settings", [{"materials": "delight"}, {"fit_iterations": 60}, {"visibility": "none"}, {"sparsity": 0.0, "smoothness": 0.0}]
)
def test_materials_with_other_settings(
    tmp_path: Path, mesh: str, cameras: str, pictures: str, outlines: str, settings: dict[str, Any]
) -> None:
    if bake(tmp_path, mesh, cameras, pictures, outlines, **{"materials": "fit"} | settings):
        export(tmp_path, "fit")


@pytest.mark.parametrize("scale", [1e-6, 1e6, 1e30, 1e-30])
def test_export_at_any_scale(tmp_path: Path, scale: float) -> None:
    assert bake(tmp_path, *PLAIN, to_world=Similarity(scale, np.eye(3), np.zeros(3)))
    assert export(tmp_path) or not 1e-6 <= scale <= 1e6


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("baked")
    assert bake(folder, *PLAIN, materials="delight")
    return folder


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 60000.0])
@pytest.mark.parametrize("name", ["base_color.exr", "orm.exr", "normal.exr", "emissive.exr"])
def test_export_of_hostile_textures(baked: Path, tmp_path: Path, name: str, value: float) -> None:
    folder = copy(baked, tmp_path)
    image = read_exr(folder / "bake" / "base_color.exr").copy()
    image[::3] = value
    write_exr(folder / "bake" / name, image)
    export(folder)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30, 0.0])
@pytest.mark.parametrize("name", ["position", "normal", "tangent", "uv"])
def test_export_of_hostile_meshes(baked: Path, tmp_path: Path, name: str, value: float) -> None:
    folder = copy(baked, tmp_path)
    arrays = load_file(folder / "bake" / "mesh.safetensors")
    for rows in (slice(0, 1), slice(None)):
        spoilt = {key: array.copy() for key, array in arrays.items()}
        spoilt[name][rows] = value
        save_file(spoilt, folder / "bake" / "mesh.safetensors")
        export(folder)
        (folder / "export").rename(folder / f"export {rows.stop}")


@pytest.mark.parametrize("faces", [[], [[0, 0, 0]], [[0, 1, 10**6]], [[0, 1, -1]]])
def test_export_of_hostile_faces(baked: Path, tmp_path: Path, faces: list[list[int]]) -> None:
    folder = copy(baked, tmp_path)
    arrays = load_file(folder / "bake" / "mesh.safetensors")
    save_file(arrays | {"faces": np.asarray(faces, np.int32).reshape(-1, 3)}, folder / "bake" / "mesh.safetensors")
    assert not export(folder) or faces == [[0, 0, 0]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 0.0, 1e30])
def test_export_of_hostile_light(baked: Path, tmp_path: Path, value: float) -> None:
    folder = copy(baked, tmp_path)
    light = load_file(folder / "bake" / "light.safetensors")
    save_file({key: np.full_like(array, value) for key, array in light.items()}, folder / "bake" / "light.safetensors")
    if export(folder, "delight"):
        import OpenImageIO as oiio

        pixels = oiio.ImageInput.open(str(folder / "export" / "light.hdr")).read_image()
        assert np.isfinite(pixels).all() and pixels.min() >= 0


def copy(folder: Path, to: Path) -> Path:
    import shutil

    for name in ("ingest", "poses", "refine", "bake"):
        shutil.copytree(folder / name, to / name)
    return to


# -- light search and delighting -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("colour", [0.0, 1.0, 1e-30, 1e6])
@pytest.mark.parametrize("count", [0, 1, 50])
def test_light_search(colour: float, count: int) -> None:
    """All pixels equal, none, or one; shading that is constant or vanishes."""
    rng = np.random.default_rng(0)
    texel = rng.integers(0, 20, count)
    for shading in (0.0, 1.0, 1e6):

        def shade(value: float, roughness: np.ndarray, metallic: float, shading: float = shading) -> np.ndarray:
            return np.full((count, 3), shading * (value + 0.04), np.float32)

        def samples(intensity: np.ndarray, contrast: float, shade: Any = shade) -> Sequence[PhotoSamples]:
            return [
                PhotoSamples(
                    texel, np.full((count, 3), colour, np.float32), np.ones(count, np.float32), texel.astype(np.int32), linear(shade)
                )
            ]

        found = search_light(samples, np.full(20, 0.3, np.float32))
        assert np.isfinite(found.intensity).all() and np.isfinite([found.contrast, found.roughness_shift, found.improvement]).all()


@pytest.mark.parametrize("radiance", [0.0, 1e-30, 1.0, 1e6])
@pytest.mark.parametrize("contrast", [0.5, 1.0, 2.0])
def test_adjusted_radiance(radiance: float, contrast: float) -> None:
    light = np.full((6, 8, 8, 3), radiance, np.float32)
    assert np.isfinite(adjust_radiance(light, np.ones(3), contrast, solid_angles(8))).all()
    light[0] = 0
    assert np.isfinite(adjust_radiance(light, np.ones(3), contrast, solid_angles(8))).all()


@pytest.mark.parametrize("colour", [0.0, 1.0, 1e-30, 1e6])
@pytest.mark.parametrize("count", [0, 1, 2, 200])
def test_delighting(colour: float, count: int) -> None:
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(count, 3))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    for position in (rng.normal(size=(count, 3)), np.zeros((count, 3))):
        colours, occlusion = np.full((count, 3), colour), np.zeros(count)
        irradiance = find_irradiance(colours, normal, position, occlusion)
        base, intensity = remove_shading(colours, normal, occlusion, irradiance)
        assert np.isfinite(irradiance.coefficients).all() and np.isfinite(base).all() and np.isfinite(intensity)
