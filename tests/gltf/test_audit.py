"""Every audit rule fails for a matching defect."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gsbake.gltf.audit import audit, failed
from gsbake.gltf.container import pack_glb, unpack_glb
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.imaging.png import encode_png

EXTRAS = {"scale": "unknown"}


def broken(data: bytes) -> set[str]:
    return {f.rule for f in audit(data, "a.glb", 5, 100_000) if not f.passed}


def test_a_valid_asset_passes(glb: bytes) -> None:
    findings = audit(glb, "a.glb", 5, 100_000)
    assert [f for f in findings if not f.passed and f.severity != "info"] == []
    assert len(findings) > 30


def with_values(mesh: GltfMesh, name: str, change: Callable[[np.ndarray], Any]) -> GltfMesh:
    values = getattr(mesh, name).copy()
    change(values)
    return replace(mesh, **{name: values})


def put(index: Any, value: Any) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[index] = value

    return change


@pytest.mark.parametrize(
    ("name", "change", "rule"),
    [
        ("normal", put((3, 0), 2.0), "unit normals"),
        ("tangent", put((3, 3), 0.5), "unit tangents"),
        ("uv", put((3, 0), 1.2), "UVs in 0..1"),
        ("faces", put((0, 0), 10_000), "indices in range"),
        ("faces", put(0, (1, 1, 1)), "no degenerate triangles"),
    ],
)
def test_broken_attributes(mesh: GltfMesh, images: GltfTextures, name: str, change: Callable[[np.ndarray], Any], rule: str) -> None:
    assert rule in broken(build_glb(with_values(mesh, name, change), images, "b", "g", "", EXTRAS))


def test_nan_position(mesh: GltfMesh, images: GltfTextures, glb: bytes) -> None:
    document, binary = unpack_glb(glb, "a")
    changed = bytearray(binary)
    changed[0:4] = np.float32(np.nan).tobytes()
    assert {"finite values", "POSITION bounds"} <= broken(pack_glb(document, bytes(changed)))


def test_mirrored_and_overlapping_uvs(mesh: GltfMesh, images: GltfTextures) -> None:
    mirrored = replace(mesh, uv=np.column_stack([1 - mesh.uv[:, 0], mesh.uv[:, 1]]).astype(np.float32))
    assert "no mirrored UVs against the tangents" in broken(build_glb(mirrored, images, "b", "g", "", EXTRAS))
    turned = replace(mirrored, tangent=mesh.tangent * np.array([-1, 1, 1, -1], np.float32))
    assert "no mirrored UVs against the tangents" not in broken(build_glb(turned, images, "b", "g", "", EXTRAS))
    squeezed = replace(mesh, uv=np.where(mesh.uv > 0.5, mesh.uv - 0.2, mesh.uv).astype(np.float32))
    assert "no overlapping UVs" in broken(build_glb(squeezed, images, "b", "g", "", EXTRAS))


def test_triangles_that_cover_the_square_often_overlap_without_a_look_at_the_texels(
    mesh: GltfMesh, images: GltfTextures, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsbake.gltf.audit.MAX_COVERED", 0.01)
    monkeypatch.setattr("gsbake.gltf.audit.overlapping", None)
    assert "no overlapping UVs" in broken(build_glb(mesh, images, "b", "g", "", EXTRAS))


def test_tangents_out_of_the_surface(mesh: GltfMesh, images: GltfTextures) -> None:
    leaning = replace(mesh, tangent=np.column_stack([mesh.normal, mesh.tangent[:, 3]]).astype(np.float32))
    assert "tangents in the surface" in broken(build_glb(leaning, images, "b", "g", "", EXTRAS))


def pillow(mode: str, size: tuple[int, int] = (128, 128), **options: Any) -> bytes:
    out = io.BytesIO()
    Image.new(mode, size, 128 if mode == "L" else (128, 128, 255, 255)[: len(mode)]).save(out, "PNG", **options)
    return out.getvalue()


def test_broken_images(mesh: GltfMesh, images: GltfTextures) -> None:
    def rules(**changed: bytes) -> set[str]:
        return broken(build_glb(mesh, replace(images, **changed), "b", "g", "", EXTRAS))

    assert "normal: 8-bit RGB PNG" in rules(normal=pillow("RGBA"))
    assert "normal: square power of two" in rules(normal=pillow("RGB", (96, 128)))
    gamma = PngInfo()
    gamma.add(b"gAMA", (45455).to_bytes(4, "big"))
    assert "base_color: no colour chunks" in rules(base_color=pillow("RGB", pnginfo=gamma))
    assert "orm: PNG" in rules(orm=pillow("RGB")[:8])
    assert "readable images" in rules(orm=b"\xff\xd8\xff\xe0 not a JPEG")
    assert "normal map of unit vectors" in rules(normal=encode_png(np.full((128, 128, 3), 128, np.uint8)))
    inward = np.tile(np.array([128, 128, 0], np.uint8), (128, 128, 1))
    assert "normal map points outwards" in rules(normal=encode_png(inward))
    assert "base colour within 30..243" in rules(base_color=encode_png(np.zeros((128, 128, 3), np.uint8)))


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (lambda d: d["asset"].update(version="1.0"), "glTF version"),
        (lambda d: d["asset"].pop("generator"), "generator"),
        (lambda d: d["asset"].pop("extras"), "scale is stated"),
        (lambda d: d["materials"].append({}), "one mesh, one material"),
        (lambda d: d["materials"][0].update(alphaMode="BLEND"), "opaque"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "no required extensions"),
        (lambda d: d["accessors"][0]["max"].__setitem__(0, 9.0), "POSITION bounds"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("TANGENT"), "attributes present"),
        (lambda d: d["materials"][0].update(occlusionTexture={"index": 0}), "occlusion packed with roughness"),
        (lambda d: d["buffers"][0].update(byteLength=10), "buffer views aligned"),
        (lambda d: d["images"][0].update(uri="x.png"), "self-contained"),
    ],
)
def test_broken_documents(glb: bytes, change: Callable[[dict[str, Any]], Any], rule: str) -> None:
    document, binary = unpack_glb(glb, "a")
    change(document)
    assert rule in broken(pack_glb(document, binary))


def test_limits(glb: bytes) -> None:
    findings = {f.rule: f for f in audit(glb, "a.glb", 0.001, 100)}
    assert not findings["file size"].passed and findings["file size"].severity == "warning"
    assert [f.rule for f in failed(list(findings.values()))] == ["triangle count"]


def test_an_unreadable_file() -> None:
    (only,) = audit(b"nothing", "a.glb", 5, 100)
    assert only.rule == "readable GLB" and not only.passed and only.severity == "error"


def test_long_oblique_triangles_are_not_looked_for(mesh: GltfMesh, images: GltfTextures, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their boxes are large although they cover little: the rule says that it did not look."""
    monkeypatch.setattr("gsbake.gltf.audit.overlapping", None)
    monkeypatch.setattr("gsbake.gltf.audit.MAX_BOXES", 0.1)
    glb = build_glb(mesh, images, "b", "g", "", EXTRAS)
    found = next(f for f in audit(glb, "a", 20, 100_000) if f.rule == "no overlapping UVs")
    assert found.passed and found.severity == "info" and "not looked at" in found.detail
