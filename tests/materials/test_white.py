"""Patches of known reflectance: how they are named, and that they set brightness and colour of base colour and light."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from gsbake.config.load import load_profile
from gsbake.config.schema import Bake
from gsbake.config.white import PrintedWhite, WhitePatch, parse_white
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet, Similarity
from gsbake.geometry.ply import write_mesh
from gsbake.imaging.exr import read_exr
from gsbake.imaging.srgb import encode_bytes
from gsbake.materials import bake as bake_module
from gsbake.materials.bake import BakeOptions, bake_textures
from gsbake.materials.white import WhiteTexels, common_factor, on_object
from gsbake.shading.environment import EnvironmentLight
from gsbake.texturing.texture_size import TextureSize
from tests.support.cameras import look_at
from tests.support.recorder import Recorder

PHOTO, SIZE = 120, 128
TO_WORLD = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 4, 5]))
AXES = np.array([[1, 0.2, 0.1], [-1, 0.1, 0.2], [0.1, 1, 0.2], [0.2, -1, 0.1], [0.2, 0.1, 1], [0.1, 0.2, -1]])
#: Of the ball, in the photos: paper about one pole, the rest darker and of another colour.
PAPER, REST = np.array([0.6, 0.5, 0.4]), np.array([0.1, 0.15, 0.3])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of two colours in photos of half the size of the user's."""
    folder = tmp_path_factory.mktemp("white")
    for name in ("ingest", "poses/photos", "mesh", "refine"):
        (folder / name).mkdir(parents=True)
    ball = trimesh.creation.icosphere(subdivisions=4)
    for name in ("mesh.ply", "dense.ply"):
        write_mesh(folder / "mesh" / name, ball.vertices, ball.faces)
    cameras = tuple(
        look_at(3 * a / np.linalg.norm(a), size=PHOTO, focal=1.2 * PHOTO, name=f"p{k}", up=(0.3, 0.5, 0.8)) for k, a in enumerate(AXES)
    )
    for camera in cameras:
        ray = camera.rays().reshape(-1, 3)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        b = ray @ camera.centre
        root = b * b - (camera.centre @ camera.centre - 1)
        p = camera.centre + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray
        colour = np.where((root > 0)[:, None], np.where(p[:, :1] > 0.8, PAPER, REST), 0)
        cv2.imwrite(str(folder / "poses/photos" / f"{camera.name}.png"), encode_bytes(colour).reshape(PHOTO, PHOTO, 3)[..., ::-1])
    CameraSet(cameras, TO_WORLD, "given").save(folder / "poses/cameras.json")
    CameraSet(tuple(c.moved(TO_WORLD) for c in cameras)).save(folder / "poses/photo_cameras.json")
    photos = [{"name": c.name, "source": f"{c.name}.jpg", "source_width": 2 * PHOTO, "source_height": 2 * PHOTO} for c in cameras]
    (folder / "ingest/photos.json").write_text(json.dumps({"photos": photos}))
    return folder


def bake(run: Path, out: Path, *white: str, **settings: Any) -> tuple[dict[str, Any], Recorder]:
    out.mkdir()
    monitor = Recorder()
    given = {"size": SIZE, "occlusion_rays": 4, "fit_iterations": 20, "fit_size": 64, "materials": "delight"} | settings
    options = BakeOptions(Bake(**given, white=white), holdout=0, light_size=8)
    results = bake_textures(*(run / stage for stage in ("ingest", "poses", "refine", "mesh")), out, options, monitor=monitor)
    return results, monitor


def light(out: Path) -> np.ndarray:
    return np.asarray(EnvironmentLight.load(out / "light.safetensors").radiance().detach().numpy())


@pytest.mark.parametrize("materials", ["delight", "fit"])
def test_base_colour_is_right_there_and_the_light_inversely(run: Path, tmp_path: Path, materials: str) -> None:
    """A pixel of the user's photo, in the middle of the paper that the first camera sees."""
    middle = f"p0.jpg:{PHOTO:g},{PHOTO:g}"
    plain, _ = bake(run, tmp_path / "plain", materials=materials)
    results, monitor = bake(run, tmp_path / "white", f"{middle}:0.5", materials=materials)
    before, after = (read_exr(tmp_path / name / "base_color.exr") for name in ("plain", "white"))
    factor = np.array(results["white_factor"])
    assert "white_factor" not in plain and np.abs(factor - 1).max() > 0.1
    assert np.allclose(after, np.minimum(before * factor, 1), atol=2e-3)
    assert np.allclose(light(tmp_path / "white") * factor, light(tmp_path / "plain"), rtol=1e-3, atol=1e-5)
    paper = after[(after > 0.3).all(2)]
    assert len(paper) > 100 and np.allclose(np.median(paper, 0), 0.5, atol=0.03)
    assert f"patch '{middle}:0.5': " in monitor.decisions["white"][1] and "where 0.5 is known" in monitor.decisions["white"][1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("p0.jpg:4,4", "'p0.jpg:4,4' is not on the object"),
        ("p0.jpg:400,4", "400,4 of a white patch lies outside the photo p0.jpg"),
        ("p9.jpg:4,4", "A white patch names the photo 'p9.jpg', which is none of the photos"),
    ],
)
def test_a_patch_that_is_not_on_the_object_is_refused_before_the_fit(run: Path, tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(BadInputError, match=words.replace(".", r"\.")):
        bake(run, tmp_path / "out", text, materials="fit")
    assert not list((tmp_path / "out").iterdir())


def test_colours_that_contain_the_light_have_none_to_divide(run: Path, tmp_path: Path) -> None:
    results, monitor = bake(run, tmp_path / "out", f"p0.jpg:{PHOTO},{PHOTO}", materials="none")
    assert "white_factor" not in results
    assert any("bake.white is not used: bake.materials is none" in text for text in monitor.warnings)


def test_several_patches() -> None:
    colour = np.array([[0.3, 0.45, 0.9], [0.2, 0.2, 0.2], [0.004, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]], np.float32)
    emission = np.float32(0.8) * (np.arange(5)[:, None] == 4) * np.ones((1, 3), np.float32)
    values = np.column_stack([colour, np.full(5, 0.5), np.zeros(5), emission]).astype(np.float32)
    seen = np.array([True, True, True, False, True])

    def factor(*patches: tuple[str, int]) -> tuple[list[float], list[str]]:
        monitor = Recorder()
        named = [(parse_white(text), np.array([k])) for text, k in patches]
        whites = [WhiteTexels(patch, texel) for patch, texel in named if isinstance(patch, WhitePatch)]
        return common_factor(on_object(values, seen, whites), monitor).round(4).tolist(), monitor.warnings

    assert factor(("a:1,1", 0)) == ([3, 2, 1], [])
    mean, warnings = factor(("a:1,1", 0), ("a:2,2:0.2", 1))
    assert mean == pytest.approx(np.sqrt([3, 2, 1]), abs=1e-3) and ["contradict each other by a factor of 3.00" in warnings[0]] == [True]
    for k in (2, 3, 4):  # black, unseen, taken for a lamp
        mean, warnings = factor(("a:1,1", k), ("a:2,2:0.2", 1))
        assert mean == [1, 1, 1] and "patch 'a:1,1' is black, clipped, taken for a lamp or hardly seen" in warnings[0]
        assert factor(("a:1,1", k))[0] == [1, 1, 1]


def test_an_overexposed_patch_is_not_used(run: Path, tmp_path: Path) -> None:
    bright = tmp_path / "run"
    shutil.copytree(run, bright)
    photo = bright / "poses/photos/p0.png"
    image = cv2.imread(str(photo))
    image[PHOTO // 2 - 6 : PHOTO // 2 + 6, PHOTO // 2 - 6 : PHOTO // 2 + 6] = 255
    cv2.imwrite(str(photo), image)
    results, monitor = bake(bright, tmp_path / "out", f"p0.jpg:{PHOTO:g},{PHOTO:g}:0.5")
    assert results["white_factor"] == [1, 1, 1] and any("is black, clipped" in text for text in monitor.warnings)


def test_a_finer_base_colour_has_the_same_factor(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its photos are divided by gains that contain it."""
    given: list[np.ndarray] = []

    def fine(surface: object, photos: object, coarse: np.ndarray, size: int, gains: np.ndarray, *_: object) -> np.ndarray:
        given.append(gains)
        return coarse

    monkeypatch.setattr(bake_module, "fine_base_color", fine)
    monkeypatch.setattr(bake_module, "texture_size", lambda *_: TextureSize(4096, 4096.0))
    bake(run, tmp_path / "plain", size="auto")
    results, _ = bake(run, tmp_path / "white", f"p0.jpg:{PHOTO:g},{PHOTO:g}:0.5", size="auto")
    np.testing.assert_allclose(given[1], given[0] / np.array(results["white_factor"]), rtol=1e-6)


def test_how_patches_are_written() -> None:
    paper, grey = parse_white("my photo.jpg:12,30.5"), parse_white("a:b.jpg:1,2:.18")
    assert isinstance(paper, WhitePatch) and isinstance(grey, WhitePatch)
    assert (paper.position.photo, paper.position.x, paper.position.y, paper.reflectance) == ("my photo.jpg", 12, 30.5, 0.9)
    assert (grey.position.photo, grey.reflectance) == ("a:b.jpg", 0.18)
    assert parse_white("markers") == PrintedWhite("markers", 0.9, "markers") and parse_white(" card ") == PrintedWhite("card", None, "card")
    assert parse_white("markers:.8") == PrintedWhite("markers", 0.8, "markers:.8")
    for text in ("card:1", "a.jpg", "a.jpg:1", ":1,2", "a.jpg:-1,2"):
        with pytest.raises(ValueError, match="no patch of known reflectance"):
            parse_white(text)
    with pytest.raises(ValueError, match="reflectance of 'a.jpg:1,2:9' must be from 0.02 to 1"):
        parse_white("a.jpg:1,2:9")
    with pytest.raises(BadInputError, match=r"bake\.white.*'far' is no patch"):
        load_profile("relight", ['bake.white=["far"]'])
