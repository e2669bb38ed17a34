"""The GLB as read by other readers and by gsbake's own."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gsbake.errors import BadInputError
from gsbake.gltf.audit import audit, failed
from gsbake.gltf.container import pack_glb, unpack_glb
from gsbake.gltf.read import parse_glb
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.imaging.png import encode_png
from gsbake.report.asset import from_gltf
from tests.support.node import gltf_issues


def test_trimesh_reads_the_same_mesh(glb: bytes, mesh: GltfMesh) -> None:
    scene = trimesh.load(io.BytesIO(glb), file_type="glb", process=False)
    (read,) = scene.geometry.values()
    assert np.array_equal(read.faces, mesh.faces)
    assert np.allclose(read.vertices, mesh.position) and np.allclose(read.vertex_normals, mesh.normal, atol=1e-6)
    # trimesh flips v on load: its image origin is at the bottom.
    assert np.allclose(read.visual.uv, np.column_stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]]), atol=1e-6)
    assert read.visual.material.baseColorTexture.size == (128, 128)
    assert read.visual.material.metallicRoughnessTexture.getpixel((0, 0)) == (250, 180, 0)
    assert read.visual.material.normalTexture.getpixel((0, 0)) == (128, 128, 255)


def test_own_reader_round_trip(glb: bytes, mesh: GltfMesh, images: GltfTextures) -> None:
    asset = parse_glb(glb, "ball")
    assert set(asset.attributes) == {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    assert np.array_equal(asset.attributes["TANGENT"], mesh.tangent) and np.array_equal(asset.faces, mesh.faces)
    assert asset.images == (images.base_color, images.orm, images.normal)
    assert asset.roles == {"base_color": 0, "orm": 1, "occlusion": 1, "normal": 2}
    assert asset.document["asset"] == {"version": "2.0", "generator": "gsbake test", "copyright": "me", "extras": {"scale": "unknown"}}


@pytest.mark.parametrize("flat", [True, False])
def test_emission_is_an_emissive_texture(mesh: GltfMesh, images: GltfTextures, flat: bool) -> None:
    emission = np.zeros((128, 128, 3), np.uint8)
    emission[:64] = (0, 180, 240)
    textures = GltfTextures(images.base_color, images.orm, None if flat else images.normal, encode_png(emission))
    data = build_glb(mesh, textures, "emitter", "test")
    asset = parse_glb(data, "emitter")
    lit = asset.image("emissive")
    assert lit is not None and np.array_equal(lit, emission)
    (read,) = trimesh.load(io.BytesIO(data), file_type="glb", process=False).geometry.values()
    assert read.visual.material.emissiveTexture.getpixel((0, 0)) == (0, 180, 240)
    assert list(read.visual.material.emissiveFactor) == [1, 1, 1]


def test_small_meshes_use_short_indices_and_large_ones_do_not(images: GltfTextures) -> None:
    for count, kind in ((65534, 5123), (65535, 5125)):
        column = np.zeros((count, 3), np.float32)
        large = GltfMesh(column, column, np.zeros((count, 4), np.float32), column[:, :2], np.array([[0, 1, count - 1]], np.int32))
        asset = parse_glb(build_glb(large, images, "n", "g"), "n")
        assert asset.document["accessors"][4]["componentType"] == kind and asset.faces.tolist() == [[0, 1, count - 1]]


def test_damaged_files_are_named() -> None:
    good = pack_glb({"asset": {"version": "2.0"}}, b"abc")
    assert unpack_glb(good, "x") == ({"asset": {"version": "2.0"}}, b"abc\0")
    for bad in (b"", good[:-5], b"PK" + good[2:], good + b"\0\0\0\0"):
        with pytest.raises(BadInputError, match=r"x\.glb"):
            unpack_glb(bad, "x.glb")
    with pytest.raises(BadInputError, match="no readable triangle mesh"):
        parse_glb(good, "x.glb")


def test_factors_replace_constant_maps(mesh: GltfMesh, images: GltfTextures) -> None:
    occlusion = np.random.default_rng(2).integers(99, 256, (128, 128), np.uint8)
    plain = GltfTextures(images.base_color, encode_png(occlusion), images.normal)
    data = build_glb(mesh, plain, "ball", "g", extras={"scale": "unknown"}, factors=(0.8, 0.25))
    asset = parse_glb(data, "ball")
    assert asset.roles == {"base_color": 0, "occlusion": 1, "normal": 2}
    assert not failed(audit(data, "ball", 5.0, 10_000))
    drawn = from_gltf(asset, False, "ball").orm
    assert drawn is not None and np.allclose(drawn[..., 0], occlusion / 255) and np.allclose(drawn[..., 1:], [0.8, 0.25])


def test_an_empty_mesh_is_rejected(mesh: GltfMesh, images: GltfTextures) -> None:
    with pytest.raises(ValueError, match="empty"):
        build_glb(GltfMesh(mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces[:0]), images, "n", "g")


def test_khronos_validator_finds_nothing(glb: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(glb)
    assert gltf_issues(tmp_path / "a.glb") == []
    (tmp_path / "b.glb").write_bytes(glb.replace(b"POSITION", b"POSITIOM"))
    assert gltf_issues(tmp_path / "b.glb")  # and it does look
