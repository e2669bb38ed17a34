"""glTF files that ask for more memory than there is, or name what they do not have: one sentence, before anything is made."""

from __future__ import annotations

import json
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.cli import main
from gsbake.errors import BadInputError
from gsbake.gltf.read import read_glb
from gsbake.gltf.scene import open_scene
from gsbake.imaging.encoded import image_size
from gsbake.viewing.inspect import inspect_file
from gsbake.viewing.render import SceneRenderer
from tests.support.gltf_files import two_triangles
from tests.support.large_files import many_primitives, png_header, sparse_file, textured_glb, write_json

#: Memory that is free in these tests: readers may take three quarters of it.
FREE = 400_000_000


@pytest.fixture(autouse=True)
def little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: FREE)


def refused(path: Path, message: str) -> None:
    """Opening the file ends in a sentence that names it, and takes little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(BadInputError, match=message) as caught:
            inspect_file(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert path.name in str(caught.value) and "\n" not in str(caught.value) and caught.value.exit_code == 42
    assert peak < 50_000_000


def test_every_uv_set_counts(tmp_path: Path) -> None:
    document = many_primitives(30_000, 1)
    primitive = document["meshes"][0]["primitives"][0]
    document["accessors"].append({"componentType": 5126, "count": 30_000, "type": "VEC2"})
    primitive["attributes"] |= {f"TEXCOORD_{k}": len(document["accessors"]) - 1 for k in range(1000)}
    refused(write_json(tmp_path / "a.gltf", document), r"needs 0?\.?7[\d.]* GB of memory")


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (many_primitives(60_000, 100), r"needs 1\.9 GB of memory to be read, and 0\.3 GB may be used"),
        (many_primitives(60_000, 1, nodes=100), r"needs 1\.9 GB of memory"),
        (many_primitives(10**10, 1), "3333333333 triangles, more than"),
        (many_primitives(16_000_000, 3000), "16000000000|15999999000 triangles, more than"),
        (many_primitives(3, 1000, nodes=1000), "1000000 parts, more than"),
    ],
)
def test_counts_are_added_up_before_anything_is_made(tmp_path: Path, document: dict[str, Any], message: str) -> None:
    refused(write_json(tmp_path / "a.gltf", document), message)


def test_what_is_never_drawn_is_not_made(tmp_path: Path) -> None:
    """Attributes that the reader does not use may be as long as they like."""
    document = two_triangles()
    document["accessors"].append({"componentType": 5126, "count": 3, "type": "MAT4"})
    document["meshes"][0]["primitives"][0]["attributes"]["_OTHER"] = 1
    assert len(open_scene(write_json(tmp_path / "a.gltf", document)).parts) == 2


def test_many_views_of_one_buffer(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(3_000_000))
    document = two_triangles(buffers=[{"byteLength": 3_000_000, "uri": "a.bin"}])
    document["bufferViews"] = [{"buffer": 0, "byteLength": 3_000_000}] * 200
    document["accessors"] = [{"bufferView": k, "componentType": 5126, "count": 3, "type": "VEC3"} for k in range(200)]
    document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": k}} for k in range(200)]
    with pytest.raises(BadInputError, match="of memory to be read"):
        open_scene(write_json(tmp_path / "a.gltf", document))


def test_sparse_files_are_refused_by_their_size(tmp_path: Path) -> None:
    refused(sparse_file(tmp_path / "a.glb"), r"needs 1e\+03 GB")
    sparse_file(tmp_path / "b.bin")
    refused(write_json(tmp_path / "b.gltf", two_triangles(buffers=[{"byteLength": 36, "uri": "b.bin"}])), r"needs 1e\+03 GB")
    with pytest.raises(BadInputError, match=r"a\.glb' needs"):
        read_glb(tmp_path / "a.glb")


def test_json_that_grows_when_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    path.write_text(f'{{"asset": {{"version": "2.0"}}, "extras": [{"[]," * 2_000_000}0]}}')
    refused(path, "of memory to be read")


def test_the_header_of_an_image_is_enough(tmp_path: Path) -> None:
    """A texture of 32000² is refused whatever the memory, one of 16000² where there is not enough; `compare` and `render` as `inspect`."""
    path = tmp_path / "a.glb"
    path.write_bytes(textured_glb(png_header(32_000, 32_000)))
    refused(path, r"states 32000 × 32000 pixels, and textures have 1 to 16384 a side")
    with pytest.raises(BadInputError, match="32000 × 32000"):
        SceneRenderer(open_scene(path))
    path.write_bytes(textured_glb(png_header(16_000, 16_000)))
    refused(path, r"image 0 of .*a\.glb' needs 6\.14 GB of memory to be read, and 0\.3 GB may be used")
    with pytest.raises(BadInputError, match=r"needs 6\.14 GB|needs 12\.3 GB"):
        SceneRenderer(open_scene(path))
    with pytest.raises(BadInputError, match=r"image of the asset needs 6\.14 GB"):
        read_glb(path).image("base_color")


def test_a_png_that_is_cut_off_is_not_decoded() -> None:
    """Deflate makes at most 1032 bytes of one, so a header of 2000² with a hundred bytes is refused before a decoder fills 12 MB."""
    with pytest.raises(BadInputError, match=r"its data is cut off \(2000 × 2000 pixels in \d+ bytes\)"):
        image_size(png_header(2000, 2000), "a.png")
    black = cv2.imencode(".png", np.zeros((2048, 2048, 3), np.uint8))[1].tobytes()  # compresses as well as any can
    assert image_size(black, "a.png").width == 2048
    options = [cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    photo = cv2.imencode(".jpg", np.zeros((2048, 2048, 3), np.uint8), options)[1].tobytes()
    assert image_size(photo, "a.jpg").width == 2048
    with pytest.raises(BadInputError, match="its data is cut off"):
        image_size(photo[:2000], "a.jpg")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_sizes_in_headers_are_those_of_the_pixels(suffix: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (21, 34, 3), dtype=np.uint8)
    for options in ([], [cv2.IMWRITE_WEBP_QUALITY, 50] if suffix == ".webp" else [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]):
        content = cv2.imencode(suffix, pixels, options if suffix != ".png" else [])[1].tobytes()
        found = image_size(content, "a")
        assert (found.width, found.height, found.bits) == (34, 21, 8)
        for cut in range(0, 21, 3):  # a header that is cut off is no image
            with pytest.raises(BadInputError, match="cannot be decoded"):
                image_size(content[:cut], "a")
    deep = cv2.imencode(".png", pixels.astype(np.uint16) * 257)[1].tobytes()
    assert image_size(deep, "a").bits == 16


def test_images_of_other_formats_reach_no_decoder() -> None:
    for suffix in (".bmp", ".tiff", ".hdr", ".pgm"):
        pixels = np.zeros((8, 8, 3), np.float32 if suffix == ".hdr" else np.uint8)
        with pytest.raises(BadInputError, match="it must be PNG, JPEG or WebP"):
            image_size(cv2.imencode(suffix, pixels[..., 0] if suffix == ".pgm" else pixels)[1].tobytes(), "a")


ACCESSOR = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
PRIMITIVE = {"attributes": {"POSITION": 0}}


@pytest.mark.parametrize(
    "change",
    [
        {"meshes": [{"primitives": [PRIMITIVE | {"material": 99}]}]},
        {"meshes": [{"primitives": [PRIMITIVE | {"material": -1}]}]},
        {"meshes": [{"primitives": [PRIMITIVE | {"material": "0"}]}]},
        {"meshes": [{"primitives": [PRIMITIVE | {"indices": 0}]}]},
        {"meshes": [{"primitives": [{"attributes": {"POSITION": -1}}]}]},
        {"meshes": [{"primitives": [{"attributes": {"POSITION": True}}]}]},
        {"meshes": [{"primitives": [PRIMITIVE | {"attributes": {"POSITION": 0, "TEXCOORD_0": 0}}]}]},
        {"meshes": [{"primitives": 5}]}, {"meshes": [[]]}, {"meshes": {"a": 1}},
        {"nodes": 5}, {"nodes": [5]}, {"nodes": "text"}, {"nodes": [{"mesh": -1}]}, {"nodes": [{"mesh": 0, "children": 5}]},
        {"nodes": [{"mesh": 0, "children": [7]}]}, {"nodes": [{"children": [1]}, {"children": [0]}]},
        {"nodes": [{"children": [k + 1]} for k in range(9999)] + [{"mesh": 0}], "scenes": [{"nodes": [0]}]},
        {"nodes": [{"mesh": 0, "matrix": [float("nan")] * 16}]}, {"nodes": [{"mesh": 0, "scale": [1e308, 1e308, 1e308]}]},
        {"nodes": [{"mesh": 0, "translation": [10**400, 0, 0]}]},
        {"scenes": 5}, {"scene": 5}, {"scene": -1}, {"scenes": [{"nodes": [-1]}]},
        {"animations": 7}, {"animations": [7]}, {"skins": 3}, {"skins": [None]}, {"cameras": "x"}, {"cameras": [1]},
        {"accessors": [ACCESSOR | {"count": float("nan")}]}, {"accessors": [ACCESSOR | {"count": -3}]}, {"accessors": [None]},
        {"accessors": [ACCESSOR | {"count": 3.0}]}, {"accessors": [ACCESSOR | {"bufferView": -1}]},
        {"bufferViews": [{"buffer": -1, "byteLength": 36}]}, {"bufferViews": [{"buffer": 0, "byteLength": -(2**62)}]},
        {"materials": [5]}, {"materials": [{"pbrMetallicRoughness": {"roughnessFactor": float("nan")}}]},
        {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": -1}}}]},
        {"materials": [{"alphaCutoff": 10**400}]}, {"materials": [{"emissiveFactor": [1e300, 0, 0]}]},
        {"extensionsUsed": 5}, {"extensionsRequired": {"a": 1}}, {"images": [5]}, {"textures": 1}, {"samplers": [[]]},
    ],
)  # fmt: skip
def test_entries_and_indices_that_are_none(tmp_path: Path, change: dict[str, Any]) -> None:
    """Lists of the wrong kind, indices without an entry, nodes that are no tree, numbers that are none."""
    path = write_json(tmp_path / "a.gltf", two_triangles(**change))
    with pytest.raises(BadInputError, match=r"a\.gltf' is not a valid glTF file|holds no triangles") as caught:
        inspect_file(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


def test_the_command_says_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_json(tmp_path / "a.gltf", two_triangles(animations=7))
    for arguments in (["inspect", str(path)], ["compare", str(path), str(path)]):
        monkeypatch.setattr(sys, "argv", ["gsbake", *arguments])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 42
        assert "a.gltf' is not a valid glTF file (animations is no list of objects)" in " ".join(capsys.readouterr().err.split())
    assert json.loads(path.read_text())["animations"] == 7
