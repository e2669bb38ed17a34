"""Small text files that users and other machines write: profiles, project.json, replaced.json, manifests, leases."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from blake3 import blake3
from hypothesis import strategies as st

from gsbake.config.load import LoadedProfile, load_profile
from gsbake.errors import BadInputError
from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.pipeline.project import PROJECT, Project
from gsbake.pipeline.store import MANIFEST, REPLACEMENT, Store, read_manifest
from tests.fuzz.harness import damaged, edges, fuzz, json_values, odd_floats, odd_text, outcome, replaced_values

#: Documents that exhaust the stack of a parser, and numbers that are too long for Python.
DEEP = [b"[" * 20_000, b'{"a":' * 9000, b'{"a": ' + b"9" * 5000 + b"}", b'{"a": ' + b"9" * 400 + b"}", b"\xef\xbb\xbf{}", b"\xff\xfe{\0}\0"]
PROJECT_BODY = {
    "photos": "/photos", "masks": None, "poses": "/photos/transforms.json", "profile": "preview", "overrides": ["a.b=5"], "seed": 7,
    "published": {"asset.glb": "0" * 64},
}  # fmt: skip
MANIFEST_BODY = {
    "stage": "mesh", "key": "ab" * 32, "settings": {"mesh.holes": "fill"}, "finished": "2026-01-01", "replaced": {"a.bin": "/a.bin"},
    "files": {"a.bin": {"digest": blake3(b"content").hexdigest(), "bytes": 7}, "b/c": {"digest": "00", "bytes": 0}},
}  # fmt: skip
HOLDER_BODY = {"host": "h", "boot": "b", "pid": 1, "started": 1.0e9, "beat": 3, "token": "0" * 32}
TOML = b"""extends = "preview"
description = "test"
[train]
iterations = 500
holdout = 8
[mesh]
holes = "leave"
"""


def json_files(body: dict[str, Any]) -> st.SearchStrategy[bytes]:
    """The document with other values, with damaged bytes, or something else entirely."""
    values = replaced_values(body).map(lambda changed: json.dumps(changed).encode())
    return st.one_of(values, damaged([json.dumps(body).encode()]), st.sampled_from(DEEP), st.binary(max_size=80))


def test_project(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def check(data: bytes) -> Project | None:
        (tmp_path / PROJECT).write_bytes(data)
        project = outcome(lambda: Project.load(tmp_path), BadInputError)
        if project is not None:
            project.sources()
        return project

    fuzz(capsys, PROJECT, json_files(PROJECT_BODY), check)


def test_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A record either names a folder inside the stage's, or the look-up says what is wrong."""
    store = Store(tmp_path)
    folder = store.stage_folder("mesh")
    folder.mkdir(parents=True)

    def check(data: bytes) -> object:
        (folder / REPLACEMENT).write_bytes(data)
        found = store.replacement("mesh")
        assert found is not None and found.artifact is None and all(fault.strip() for fault in found.faults) and found.faults
        store.set_aside_unexpected("mesh", None)
        assert store.take_moved() == []
        return None if "cannot be read" in found.faults[0] else found

    fuzz(capsys, REPLACEMENT, json_files({"folder": "by-hand-01234567"}), check)


def sealed(data: bytes) -> bytes:
    """The manifest with the seal that fits, so that what is inside gets read; unchanged when it is no JSON object."""
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        return data
    if not isinstance(body, dict):
        return data
    text = json.dumps({k: v for k, v in body.items() if k != "seal"}, sort_keys=True)
    return json.dumps({**body, "seal": blake3(text.encode()).hexdigest()}).encode()


def test_manifest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A manifest with a fitting seal and any content; nothing outside the folder is looked at."""
    store = Store(tmp_path)
    folder = store.stage_folder("mesh") / "by-hand-01234567"
    folder.mkdir(parents=True)
    (folder.parent / REPLACEMENT).write_text('{"folder": "by-hand-01234567"}')
    (folder / "a.bin").write_bytes(b"content")

    def check(data: bytes) -> object:
        (folder / MANIFEST).write_bytes(data)
        found = store.replacement("mesh")
        assert found is not None and (found.artifact is None) == bool(found.faults)
        faults = [text for _, texts in store.verify("mesh") for text in texts]
        assert all(text.strip() for text in faults)
        return read_manifest(folder)

    files = st.dictionaries(
        odd_text, st.fixed_dictionaries({"digest": st.one_of(odd_text, json_values), "bytes": st.one_of(edges, json_values)})
    )
    hostile = files.map(lambda listed: json.dumps({**MANIFEST_BODY, "files": listed}).encode())
    fuzz(capsys, MANIFEST, st.one_of(st.one_of(hostile, json_files(MANIFEST_BODY)).map(sealed), json_files(MANIFEST_BODY)), check)


def test_lease(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A lease file names a holder, or counts as none."""
    path = tmp_path / "a.lease"
    lease = Lease(path)
    here = LeaseHolder.current()

    def check(data: bytes) -> LeaseHolder | None:
        path.write_bytes(data)
        holder = LeaseHolder.read(path)
        if holder is not None:
            assert holder.alive() in (True, False, None) and str(holder)
        assert not lease.held()
        return holder

    fuzz(capsys, "lease", st.one_of(json_files(HOLDER_BODY), json_files({**HOLDER_BODY, "host": here.host, "boot": here.boot})), check)


def test_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "profile.toml"

    def check(data: bytes) -> LoadedProfile | None:
        path.write_bytes(data)
        return outcome(lambda: load_profile(str(path)), BadInputError)

    values = st.one_of(
        edges.map(str), odd_floats.map(str), odd_text.map(lambda text: json.dumps(text)), st.sampled_from(["true", "false"]),
        st.sampled_from(["9" * 5000, "1_0", "0xFFFFFFFFFFFFFFFFFF", "1979-05-27", "[1, 2]", "{a = 1}", "[" * 5000, "{a = " * 3000, "'''"]),
    )  # fmt: skip
    keys = st.sampled_from(
        ["train.iterations", "mesh.holes", "ingest.max_size", "description", "extends", "train", "a.b.c", '"\\u0000"', "."]
    )
    lines = st.lists(st.builds(lambda key, value: f"{key} = {value}", keys, values), max_size=3).map(lambda all_lines: "\n".join(all_lines))
    texts = lines.map(lambda text: text.encode("utf-8", "surrogatepass"))
    fuzz(capsys, "profile TOML", st.one_of(texts, damaged([TOML]), st.sampled_from(DEEP), st.binary(max_size=80)), check)
