"""Binary files that gsbake reads back, and that users may replace: point clouds and meshes (PLY), checkpoints, GLB."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from blake3 import blake3
from hypothesis import strategies as st

from gsbake.checkpoint import DamagedCheckpointError, load_checkpoint, save_checkpoint
from gsbake.errors import BadInputError
from gsbake.geometry.ply import read_cloud, read_mesh, write_cloud, write_mesh
from gsbake.gltf.audit import audit
from gsbake.gltf.container import pack_glb
from gsbake.gltf.read import parse_glb
from gsbake.imaging.png import write_png
from gsbake.report.asset import from_gltf
from tests.fuzz.harness import damaged, edges, fuzz, odd_floats, outcome, replaced_values

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def headers(data: bytes) -> st.SearchStrategy[bytes]:
    """The PLY with words of its header replaced: other counts, types, formats, elements."""
    head, end, body = data.partition(b"end_header\n")
    words = st.one_of(edges.map(str), odd_floats.map(str), st.sampled_from(
        ["ascii", "binary_big_endian", "list", "uchar", "double", "int8", "vertex", "face", "x", "vertex_indices", "element", "comment"]
    ))  # fmt: skip

    @st.composite
    def build(draw: st.DrawFn) -> bytes:
        lines = [line.split(" ") for line in head.decode().splitlines()]
        for _ in range(draw(st.integers(1, 3))):
            line = lines[draw(st.integers(0, len(lines) - 1))]
            line[draw(st.integers(0, len(line) - 1))] = draw(words)
        return "\n".join(" ".join(line) for line in lines).encode() + b"\n" + end + body

    return build()


def test_ply_cloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.ply"
    write_cloud(path, VERTICES, np.arange(12).reshape(4, 3))
    good = path.read_bytes()

    def check(data: bytes) -> object:
        path.write_bytes(data)
        return outcome(lambda: read_cloud(path), ValueError)

    fuzz(capsys, "PLY points", st.one_of(damaged([good]), headers(good), st.binary(max_size=100)), check)


def test_ply_mesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.ply"
    write_mesh(path, VERTICES, FACES)
    good = path.read_bytes()
    text = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    text += b"property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"

    def check(data: bytes) -> object:
        path.write_bytes(data)
        mesh = outcome(lambda: read_mesh(path), ValueError)
        if mesh is not None:
            vertices, faces = mesh
            assert vertices.shape[1:] == (3,) and faces.shape[1:] == (3,) and np.isfinite(vertices).all()
            assert faces.min() >= 0 and faces.max() < len(vertices)
        return mesh

    fuzz(capsys, "PLY mesh", st.one_of(damaged([good, text]), headers(good), headers(text), st.binary(max_size=100)), check)


def test_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.checkpoint"
    save_checkpoint(
        path, {"step": 3, "rows": [torch.arange(6.0).reshape(2, 3), None, "text"], "more": {"a": torch.zeros(2, dtype=torch.int64)}}
    )
    good = path.read_bytes()
    assert load_checkpoint(path)["step"] == 3
    body = good[32:]
    length = int.from_bytes(body[:8], "little")
    head = json.loads(body[8 : 8 + length])

    def structured(structure: Any) -> bytes:
        header = json.dumps({**head, "__metadata__": {"structure": json.dumps(structure)}}).encode()
        return struct.pack("<Q", len(header)) + header + body[8 + length :]

    def shaped(header: Any) -> bytes:
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + body[8 + length :]

    def check(data: bytes) -> object:
        path.write_bytes(data)
        return outcome(lambda: (load_checkpoint(path),), DamagedCheckpointError)

    deep = b'{"__metadata__": {"structure": "' + b"[" * 20_000 + b'"}}'
    structures = replaced_values(json.loads(head["__metadata__"]["structure"])).map(structured)
    inside = st.one_of(damaged([body, struct.pack("<Q", len(deep)) + deep]), structures, replaced_values(head).map(shaped))
    sealed = inside.map(lambda data: blake3(data).digest() + data)
    fuzz(capsys, "checkpoint", st.one_of(sealed, sealed, damaged([good]), st.binary(max_size=100)), check)


def glb(tmp_path: Path) -> tuple[dict[str, Any], bytes]:
    """Document and binary chunk of a textured tetrahedron."""
    write_png(tmp_path / "a.png", np.full((16, 16, 3), 128, np.uint8))
    unit = np.array([[0, 0, 1.0]] * 4, "<f4")
    parts = [
        VERTICES.astype("<f4"), unit, np.array([[1.0, 0, 0, 1]] * 4, "<f4"), np.array([[0, 0], [1, 0], [0, 1], [1, 1]], "<f4"),
        FACES.ravel().astype("<u2"), np.frombuffer((tmp_path / "a.png").read_bytes(), np.uint8),
    ]  # fmt: skip
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": part.nbytes})
        binary += part.tobytes() + b"\0" * (-part.nbytes % 4)
    kinds = [(5126, "VEC3", 4), (5126, "VEC3", 4), (5126, "VEC4", 4), (5126, "VEC2", 4), (5123, "SCALAR", 12)]
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": kind, "count": count, "type": shape} for k, (kind, shape, count) in enumerate(kinds)
    ]
    accessors[0] |= {"min": [0, 0, 0], "max": [1, 1, 1]}
    surface = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 0}}
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TANGENT": 2, "TEXCOORD_0": 3}, "indices": 4}]}],
        "materials": [{"pbrMetallicRoughness": surface, "normalTexture": {"index": 0}, "occlusionTexture": {"index": 0}}],
        "textures": [{"source": 0}], "images": [{"bufferView": 5, "mimeType": "image/png"}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    return document, binary


def repack(document: Any, binary: bytes) -> bytes:
    """A GLB of any JSON value, NaN included."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def test_glb(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The audit names what is wrong, the reader refuses it: whatever the document says."""
    monkeypatch.setattr("gsbake.gltf.audit.OVERLAP_SIZE", 64)  # the full size takes tens of milliseconds an input
    document, binary = glb(tmp_path)
    good = pack_glb(document, binary)
    assert not [f.rule for f in audit(good, "a.glb", 10, 100) if f.rule == "readable GLB" and not f.passed]
    deep = b"[" * 20_000

    def check(data: bytes) -> object:
        findings = audit(data, "a.glb", 10.0, 100)
        assert findings and all(isinstance(f.passed, bool) and f.detail.strip() for f in findings)
        asset = outcome(lambda: parse_glb(data, "a.glb"), BadInputError)
        for role in {} if asset is None else asset.roles:
            outcome(lambda role=role: asset.image(role), BadInputError)  # type: ignore[misc,union-attr]
        if asset is not None:
            outcome(lambda: from_gltf(asset, False, "a.glb"), BadInputError)
        return asset

    documents = replaced_values(document).map(lambda body: repack(body, binary))
    chunks = damaged([binary]).map(lambda body: repack(document, body))
    stacked = struct.pack("<III", 0x46546C67, 2, 20 + len(deep)) + struct.pack("<II", len(deep), 0x4E4F534A) + deep
    fuzz(capsys, "GLB", st.one_of(documents, documents, chunks, damaged([good]), st.just(stacked), st.binary(max_size=100)), check)
