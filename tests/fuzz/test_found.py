"""Inputs that fuzzing found, or that reading the parsers with it in mind did: each once ended in a traceback, a crash or all memory."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from blake3 import blake3

from gsbake.checkpoint import DamagedCheckpointError, load_checkpoint, save_checkpoint
from gsbake.config.load import load_profile
from gsbake.errors import BadInputError
from gsbake.geometry.ply import read_cloud, read_mesh, write_mesh
from gsbake.gltf.audit import audit, failed
from gsbake.gltf.frame import read_transforms_json
from gsbake.gltf.read import parse_glb
from gsbake.pipeline.store import MANIFEST, REPLACEMENT, Store, read_manifest
from gsbake.report.manifests import audit_rows, load_manifests
from tests.fuzz.test_binary_files import FACES, VERTICES, glb, repack
from tests.fuzz.test_documents import sealed

DEEP = "[" * 20_000


def test_documents_that_are_nested_too_deeply(tmp_path: Path) -> None:
    """Python's parsers end with a RecursionError there, which is no ValueError."""
    store = Store(tmp_path)
    stage = store.stage_folder("mesh")
    stage.mkdir(parents=True)
    for name in (REPLACEMENT, MANIFEST):
        (stage / name).write_text(DEEP)
    found = store.replacement("mesh")
    assert found is not None and found.faults == (f"{REPLACEMENT} cannot be read",)
    assert read_manifest(stage) is None
    assert load_manifests({"mesh": stage}) == {"mesh": {}}
    for read in (audit_rows, read_transforms_json):
        with pytest.raises(BadInputError, match=r"is not .*export the asset again"):
            read(stage / MANIFEST)
    (tmp_path / "digests.json").write_text(DEEP)
    Store(tmp_path)
    profile = tmp_path / "a.toml"
    profile.write_text(f"a = {DEEP}")
    with pytest.raises(BadInputError, match="is not valid TOML"):
        load_profile(str(profile))
    with pytest.raises(BadInputError, match="train.iterations"):
        load_profile("smoke", [f"train.iterations={DEEP}"])
    with pytest.raises(BadInputError, match="invalid JSON"):
        parse_glb(struct.pack("<5I", 0x46546C67, 2, 20 + len(DEEP), len(DEEP), 0x4E4F534A) + DEEP.encode(), "a.glb")


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "n" * 5000])
def test_manifest_that_names_files_that_cannot_be(tmp_path: Path, name: str) -> None:
    folder = Store(tmp_path).stage_folder("mesh") / "by-hand-01234567"
    folder.mkdir(parents=True)
    (folder.parent / REPLACEMENT).write_text('{"folder": "by-hand-01234567"}')
    body = {"stage": "mesh", "replaced": {"a": "b"}, "files": {name: {"digest": "0" * 64, "bytes": 1}}}
    (folder / MANIFEST).write_bytes(sealed(json.dumps(body).encode()))
    found = Store(tmp_path).replacement("mesh")
    assert found is not None and found.artifact is None and "its manifest is damaged" in found.faults[0]


def test_manifest_whose_settings_are_no_settings(tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_bytes(sealed(b'{"files": {}, "settings": 3}'))
    assert read_manifest(tmp_path) is None


def test_mesh_with_corners_that_are_no_vertices(tmp_path: Path) -> None:
    for corner in (4, -1, 2**31 - 1):
        faces = FACES.copy()
        faces[1, 2] = corner
        write_mesh(tmp_path / "a.ply", VERTICES, faces)
        with pytest.raises(ValueError, match="corners that are no vertices"):
            read_mesh(tmp_path / "a.ply")


def test_mesh_with_an_unknown_property(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.ply", VERTICES, FACES)
    good = (tmp_path / "a.ply").read_bytes()
    for old, new in ((b"property list", b"qroperty list"), (b"float x", b"list x"), (b"vertex 4", b"vertex nan"), (b"face 4", b"face -1")):
        (tmp_path / "a.ply").write_bytes(good.replace(old, new))
        with pytest.raises(ValueError, match=r"a\.ply"):
            read_mesh(tmp_path / "a.ply")


def test_points_without_their_count(tmp_path: Path) -> None:
    for count in (b"", b" ", b" x", b" " + b"9" * 5000):
        (tmp_path / "a.ply").write_bytes(b"ply\nelement vertex" + count + b"\nend_header\n")
        with pytest.raises(ValueError, match=r"."):
            read_cloud(tmp_path / "a.ply")


def test_checkpoint_of_another_shape(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "a", [torch.zeros(2)])
    body = (tmp_path / "a").read_bytes()[32:]
    length = int.from_bytes(body[:8], "little")
    nested = json.dumps({"__metadata__": {"structure": DEEP}})
    for header in ("[1]", nested, '{"__metadata__": {"structure": "{}"}, "0": 3}', "{}" + " " * 9):
        changed = struct.pack("<Q", len(header)) + header.encode() + body[8 + length :]
        (tmp_path / "a").write_bytes(blake3(changed).digest() + changed)
        with pytest.raises(DamagedCheckpointError, match=r"."):
            load_checkpoint(tmp_path / "a")


def test_glb_that_states_more_than_it_holds(tmp_path: Path) -> None:
    """A stride of zero lets one row stand for 10¹² of them; roles may name images that are not there."""
    document, binary = glb(tmp_path)
    changes = [
        lambda d: (d["bufferViews"][0].update(byteStride=0), d["accessors"][0].update(count=10**12)),
        lambda d: d["accessors"][0].update(byteOffset=-12),
        lambda d: d["textures"][0].update(source=7),
        lambda d: d["textures"][0].update(source=-1),
        lambda d: d["meshes"][0]["primitives"][0].update(attributes=[0]),
        lambda d: d["meshes"][0]["primitives"][0].update(attributes={"NORMAL": 1}),
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(NORMAL=3),
        lambda d: d.update(materials=[3]),
    ]
    for change in changes:
        changed = json.loads(json.dumps(document))
        change(changed)
        data = repack(changed, binary)
        with pytest.raises(BadInputError, match="no readable triangle mesh|of memory to be read"):
            parse_glb(data, "a.glb")
        assert [finding.rule for finding in failed(audit(data, "a.glb", 10, 100))] == ["readable GLB"]


def test_glb_without_what_the_audit_looks_at(tmp_path: Path) -> None:
    document, binary = glb(tmp_path)
    for key in ("asset", "buffers"):
        data = repack({k: v for k, v in document.items() if k != key}, binary)
        assert "well-formed document" in [finding.rule for finding in failed(audit(data, "a.glb", 10, 100))]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -3e38, 3e38, 1e20, -1.0])
def test_glb_with_uvs_outside_the_square(tmp_path: Path, value: float) -> None:
    """Compiled code once wrote to the texels that they name."""
    document, binary = glb(tmp_path)
    start = document["bufferViews"][3]["byteOffset"]
    for at in (start, start + 4, start + 12):
        changed = binary[:at] + struct.pack("<f", value) + binary[at + 4 :]
        assert "UVs in 0..1" in [finding.rule for finding in failed(audit(repack(document, changed), "a.glb", 10, 100))]


def test_glb_whose_image_has_too_many_pixels(tmp_path: Path) -> None:
    document, binary = glb(tmp_path)
    at = binary.index(b"IHDR") + 4
    huge = binary[:at] + struct.pack(">II", 1_000_000, 1_000_000) + binary[at + 8 :]
    with pytest.raises(BadInputError, match="cannot be decoded"):
        parse_glb(repack(document, huge), "a.glb").image("normal")
    assert np.shape(parse_glb(repack(document, binary), "a.glb").image("normal")) == (16, 16, 3)
