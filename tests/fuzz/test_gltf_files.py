"""Any glTF file, GLB or JSON with a file beside it: what `inspect`, `compare`, `render` and the audit make of it, whatever it says."""

from __future__ import annotations

import base64
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from gsbake.errors import BadInputError
from gsbake.gltf.read import parse_glb
from gsbake.gltf.scene import Scene, open_scene
from gsbake.report.asset import from_gltf
from gsbake.report.lights import procedural
from gsbake.viewing.compare import compare_images, compare_surfaces, surface_of
from gsbake.viewing.inspect import inspect_file
from gsbake.viewing.render import SceneRenderer
from gsbake.viewing.turntable import orbit
from tests.fuzz.harness import damaged, fuzz, outcome, replaced_values
from tests.fuzz.test_binary_files import glb, repack
from tests.support.gltf_files import two_triangles

#: Memory that the readers may take: some inputs ask for more.
MEMORY = 1 << 29


def scene_document(tmp_path: Path) -> tuple[dict[str, Any], bytes]:
    """A tetrahedron with all that the reader looks at: nodes in nodes, a strip, sparse and empty accessors, colours, texture transforms."""
    document, binary = glb(tmp_path)
    start = len(binary)
    sparse = np.array([1, 2], "<u2").tobytes() + np.array([[0, 0, 0.5], [0, 0.5, 0]], "<f4").tobytes()
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": start, "byteLength": 4}, {"buffer": 0, "byteOffset": start + 4, "byteLength": 24},
        {"buffer": 0, "byteOffset": 0, "byteLength": 48, "byteStride": 12},
    ]  # fmt: skip
    document["accessors"] += [
        {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": {
            "count": 2, "indices": {"bufferView": 6, "componentType": 5123}, "values": {"bufferView": 7}}},
        {"bufferView": 8, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 0, "componentType": 5121, "count": 4, "type": "VEC4", "normalized": True},
    ]  # fmt: skip
    moved = {"KHR_texture_transform": {"offset": [0.1, 0], "rotation": 0.2, "scale": [2, 1], "texCoord": 0}}
    document["materials"].append({
        "name": "glass", "alphaMode": "BLEND", "doubleSided": True, "emissiveFactor": [1, 0.5, 0], "emissiveTexture": {"index": 1},
        "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": {"index": 1, "extensions": moved}},
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2}, "KHR_materials_unlit": {}},
    })  # fmt: skip
    document["textures"].append({"source": 0, "sampler": 0})
    document["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
    strip = {"attributes": {"POSITION": 5, "COLOR_0": 7, "TEXCOORD_0": 3}, "mode": 5, "material": 1}
    fan = {"attributes": {"POSITION": 6, "TEXCOORD_0": 3, "NORMAL": 1}, "mode": 6, "material": 0}
    document["meshes"].append({"name": "more", "primitives": [strip, fan], "weights": [0.5]})
    document["nodes"] = [
        {"mesh": 0, "children": [1, 2], "rotation": [0, 0, 0, 1], "scale": [1, 2, 1]}, {"mesh": 1, "translation": [3, 0, 0]},
        {"mesh": 1, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 2, 2, 2, 1], "skin": 0, "camera": 0},
    ]  # fmt: skip
    document |= {
        "animations": [{"channels": [], "samplers": []}], "skins": [{"joints": [0]}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}],
        "extensionsUsed": ["KHR_texture_transform", "KHR_materials_unlit", "X_other"], "extensionsRequired": ["KHR_texture_transform"],
    }  # fmt: skip
    document["asset"] |= {"generator": "hand", "copyright": "nobody", "extras": {"scale": "metres"}}
    document["buffers"][0]["byteLength"] = start + len(sparse)
    return document, binary + sparse


@pytest.fixture
def few_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Little memory, so that what asks for much is refused, and a small grid for the audit."""
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: MEMORY)
    monkeypatch.setattr("gsbake.gltf.audit.OVERLAP_SIZE", 64)


#: The light of all renders.
STUDIO = cache(lambda: procedural("Studio"))


def look_at(path: Path, good: Scene) -> object:
    """Everything that the commands do with a file; its scene, or None where it is refused."""
    figures = outcome(lambda: inspect_file(path), BadInputError)
    if figures is not None:
        json.dumps(figures)
    scene = outcome(lambda: open_scene(path), BadInputError)
    if scene is None:
        assert figures is None
        return None

    def draw() -> object:
        renderer = SceneRenderer(scene, 1)
        (camera,) = orbit(renderer.centre, renderer.radius, 1, 8)
        image = renderer.draw(camera, STUDIO(), 1)
        return compare_images(image, image)

    outcome(draw, BadInputError)
    outcome(lambda: compare_surfaces(surface_of(good), surface_of(scene), 50), BadInputError)
    return scene


@pytest.mark.usefixtures("few_bytes")
def test_glb_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document, binary = scene_document(tmp_path)
    path = tmp_path / "a.glb"
    path.write_bytes(repack(document, binary))
    good = open_scene(path)
    assert len(good.parts) == 5

    def check(data: bytes) -> object:
        path.write_bytes(data)
        asset = outcome(lambda: parse_glb(data, "a.glb", foreign=True), BadInputError)
        if asset is not None:
            outcome(lambda: from_gltf(asset, False, "a.glb"), BadInputError)
        return look_at(path, good)

    documents = st.one_of(replaced_values(document, 1), replaced_values(document)).map(lambda changed: repack(changed, binary))
    chunks = damaged([binary]).map(lambda body: repack(document, body))
    fuzz(capsys, "GLB scenes", st.one_of(documents, documents, documents, chunks, damaged([repack(document, binary)])), check)


@pytest.mark.slow
@pytest.mark.usefixtures("few_bytes")
def test_gltf_with_a_file_beside_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document, binary = scene_document(tmp_path)
    document["buffers"] = [{"byteLength": len(binary), "uri": "a%2Ebin"}, *two_triangles()["buffers"]]
    document["images"] = [{"uri": "data:image/png;base64," + base64.b64encode((tmp_path / "a.png").read_bytes()).decode()}]
    path, beside = tmp_path / "a.gltf", tmp_path / "a.bin"
    beside.write_bytes(binary)
    path.write_text(json.dumps(document))
    good = open_scene(path)
    text = path.read_bytes()

    def check(both: tuple[bytes, bytes]) -> object:
        path.write_bytes(both[0])
        beside.write_bytes(both[1])
        return look_at(path, good)

    documents = st.one_of(replaced_values(document, 1), replaced_values(document)).map(lambda changed: json.dumps(changed).encode())
    inputs = st.one_of(
        st.tuples(documents, st.just(binary)), st.tuples(st.just(text), damaged([binary])), st.tuples(damaged([text]), st.just(binary))
    )
    fuzz(capsys, "glTF with a file", inputs, check)
