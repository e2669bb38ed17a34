"""Entries of a shared store, and manifests, that somebody else wrote: they decide nothing, block nothing, and are replaced at once."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from gsbake.pipeline import shared_store, store_marker
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.store import Artifact, _seal, parse_manifest
from tests.pipeline.test_shared_store import artifacts, bake, store

DIGEST = "0" * 64


def sealed(body: dict[str, Any]) -> bytes:
    return json.dumps({**body, "seal": _seal(body)}).encode()


def files(*names: str) -> dict[str, Any]:
    return {name: {"digest": DIGEST, "bytes": 4} for name in names}


#: What an entry may be changed to.
HOSTILE: dict[str, dict[str, Any]] = {
    "digest that is a path": {"files": {"total.txt": {"digest": "../home/thesis.odt", "bytes": 4}}},
    "absolute digest": {"files": {"total.txt": {"digest": "/etc/passwd", "bytes": 4}}},
    "digest in capitals": {"files": {"total.txt": {"digest": "A" * 64, "bytes": 4}}},
    "digest that is no text": {"files": {"total.txt": {"digest": 5, "bytes": 4}}},
    "name that is a path": {"files": files("../total.txt")},
    "absolute name": {"files": files("/etc/cron.d/x")},
    "empty name": {"files": files("")},
    "name with NUL": {"files": files("a\0b")},
    "name with a newline": {"files": files("a\nb")},
    "long name": {"files": files("x" * 300)},
    "long path": {"files": files("/".join(["x" * 100] * 50))},
    "file and folder": {"files": files("a", "a/b")},
    "the manifest": {"files": files("manifest.json")},
    "below the manifest": {"files": files("manifest.json/a")},
    "device": {"files": files("nul")},
    "negative size": {"files": {"total.txt": {"digest": DIGEST, "bytes": -1}}},
    "size that is a truth": {"files": {"total.txt": {"digest": DIGEST, "bytes": True}}},
    "size that is no whole number": {"files": {"total.txt": {"digest": DIGEST, "bytes": 4.0}}},
    "list of files": {"files": ["total.txt"]},
    "other stage": {"stage": "read"},
    "other key": {"key": DIGEST},
    "results that are no mapping": {"results": 5},
    "inputs that are no mapping": {"inputs": {"read": 5}},
    "files of inputs that are no mapping": {"inputs": {"read": {"files": 5}}},
    "warnings that are no list": {"warnings": "none"},
}


@pytest.mark.parametrize("name", [name for name in HOSTILE if not name.startswith("other")])
def test_such_a_manifest_is_none(name: str) -> None:
    good = {"stage": "sum", "key": DIGEST, "settings": {}, "files": files("total.txt")}
    assert parse_manifest(sealed(good)) is not None and parse_manifest(sealed({**good, **HOSTILE[name]})) is None


def test_nested_json_is_no_manifest() -> None:
    assert parse_manifest(b"[" * 1_000_000) is None and parse_manifest(b'{"files":' * 200_000 + b"1" + b"}" * 200_000) is None


@pytest.fixture
def stored(tmp_path: Path) -> tuple[Path, CacheKey, Artifact, Path]:
    """A store with one artifact: its folder, key, artifact and entry. Beside it lies a home folder."""
    key, artifact = artifacts(tmp_path / "out", 1)[0]
    shared = tmp_path / "shared"
    assert store(str(shared)).put(artifact) is None
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.odt").write_text("mine")
    (tmp_path / "fetched").mkdir()
    return shared, key, artifact, shared / "ac" / "sum" / f"{key.digest}.json"


def check_replaced(stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path) -> None:
    """Fetch a bad entry with a patient store, put the good artifact, and fetch that."""
    shared, key, artifact, entry = stored
    start = time.monotonic()
    reader = shared_store.open_shared_store(str(shared))
    assert reader is not None and reader.fetch(key, tmp_path / "fetched") is None
    assert reader.damaged and len(reader.damaged) <= 2 and reader.put(artifact) is None
    assert time.monotonic() - start < 10  # not the patience
    (tmp_path / "good").mkdir()
    assert store(str(shared)).fetch(key, tmp_path / "good") is not None and entry.is_file()
    assert [(path.name, path.read_text()) for path in (tmp_path / "home").iterdir()] == [("thesis.odt", "mine")]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fetched", "good", "home", "out", "shared"]


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_entry_is_replaced_at_once(name: str, stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path) -> None:
    entry = stored[3]
    body = json.loads(entry.read_text())
    del body["seal"]
    real = body["files"]["total.txt"]  # what the names are given to is there
    text = json.dumps(HOSTILE[name]).replace(json.dumps({"digest": DIGEST, "bytes": 4}), json.dumps(real))
    entry.write_bytes(sealed({**body, **json.loads(text)}))
    check_replaced(stored, tmp_path)


def test_an_entry_that_is_too_large_is_not_read(stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path, monkeypatch: Any) -> None:
    os.truncate(stored[3], store_marker.MAX_ENTRY_BYTES + 1)
    monkeypatch.setattr(shared_store, "parse_manifest", lambda content: pytest.fail("it was read"))
    reader = store(str(stored[0]))
    assert reader.fetch(stored[1], tmp_path / "fetched") is None and len(reader.damaged) == 1
    monkeypatch.undo()
    assert reader.put(stored[2]) is None and store(str(stored[0])).digest_of(stored[1]) == stored[2].digest


def test_a_nested_entry_is_replaced(stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path) -> None:
    stored[3].write_bytes(b"[" * 1_000_000)
    check_replaced(stored, tmp_path)


def test_a_file_larger_than_its_entry_says_is_not_downloaded(stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path) -> None:
    blob = next(path for path in (stored[0] / "cas").rglob("*") if path.is_file())
    os.truncate(blob, 1 << 36)
    check_replaced(stored, tmp_path)


def test_an_entry_of_more_bytes_than_are_free_is_skipped(stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path) -> None:
    entry = stored[3]
    body = json.loads(entry.read_text())
    del body["seal"]
    body["files"]["total.txt"]["bytes"] = 1 << 60
    entry.write_bytes(sealed(body))
    reader = store(str(stored[0]))
    assert reader.fetch(stored[1], tmp_path / "fetched") is None and len(reader.notices) == 1 and "free" in reader.notices[0]


def test_names_that_this_system_cannot_have_are_skipped_at_once(
    stored: tuple[Path, CacheKey, Artifact, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here by a file in the way, as where capitals do not count."""
    (tmp_path / "fetched" / "total.txt").write_text("in the way")
    reader = shared_store.open_shared_store(str(stored[0]))
    assert reader is not None
    start = time.monotonic()
    assert reader.fetch(stored[1], tmp_path / "fetched") is None and len(reader.notices) == 1 and not reader.damaged
    assert time.monotonic() - start < 10 and stored[3].is_file() and (tmp_path / "fetched" / "total.txt").read_text() == "in the way"


def test_a_run_says_it_in_one_line_and_computes_the_stage(tmp_path: Path, photos: Path) -> None:
    shared = tmp_path / "shared"
    bake(tmp_path / "one", photos, str(shared))
    entry = next((shared / "ac" / "sum").iterdir())
    body = json.loads(entry.read_text())
    del body["seal"]
    real = body["files"]["total.txt"]
    entry.write_bytes(sealed({**body, "files": {"a": real, "a/b": real}}))
    start = time.monotonic()
    _, recorder, warnings = bake(tmp_path / "two", photos, str(shared), patience=120.0)
    assert recorder.ran == ["sum"] and time.monotonic() - start < 60
    assert len(warnings) == 1 and f"ac/sum/{entry.name}" in warnings[0] and "damaged and thrown away" in warnings[0]
    assert bake(tmp_path / "three", photos, str(shared))[1].ran == []
