"""Content digests, the digest cache, cache keys, settings views and worker messages."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest
from blake3 import blake3

from gsbake.pipeline import digest
from gsbake.pipeline.digest import DigestCache, file_digest, list_files, tree_digest
from gsbake.pipeline.key import CacheKey, canonical_json
from gsbake.pipeline.machine import thread_environment
from gsbake.pipeline.settings import SettingsView, UndeclaredSetting
from gsbake.pipeline.worker import one_line, to_json
from tests.pipeline.toy import Toy


def test_file_digest_is_blake3_of_the_bytes(tmp_path: Path) -> None:
    for size in (0, 5, 1 << 20, (1 << 20) + 7):
        data = os.urandom(size)
        (tmp_path / "x").write_bytes(data)
        assert file_digest(tmp_path / "x") == blake3(data).hexdigest()


def test_tree_digest_depends_on_names_and_content_only() -> None:
    assert tree_digest({"a": "1", "b": "2"}) == tree_digest({"b": "2", "a": "1"})
    assert len({tree_digest(t) for t in ({"a": "1"}, {"a": "2"}, {"b": "1"}, {}, {"a": "1", "b": "2"}, {"a1": ""})}) == 6


def test_hidden_files_are_not_listed(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    for name in ("b", "a", ".DS_Store", "sub/c"):
        (tmp_path / name).write_text(name)
    assert list_files(tmp_path) == ["a", "b", "sub/c"]
    assert list_files(tmp_path, recursive=False) == ["a", "b"]


def test_digest_cache_detects_a_rewrite_with_the_same_size_and_mtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(digest, "MIN_FILE_AGE", 0.05)
    path = tmp_path / "x"
    path.write_text("old")
    time.sleep(0.1)
    cache = DigestCache(tmp_path / "cache.json")
    old = cache.file(path)
    cache.save()
    stat = path.stat()
    path.write_text("new")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # same size, same mtime
    assert DigestCache(tmp_path / "cache.json").file(path) == blake3(b"new").hexdigest() != old


def test_digest_cache_skips_recently_modified_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x"
    path.write_text("x")
    reads: list[Path] = []
    monkeypatch.setattr(digest, "file_digest", lambda p: reads.append(p) or "digest")
    cache = DigestCache(tmp_path / "cache.json")
    cache.file(path), cache.file(path)
    assert len(reads) == 2  # just written: it may change again within the timestamp resolution
    monkeypatch.setattr(digest, "MIN_FILE_AGE", -1.0)
    cache.file(path), cache.file(path)
    cache.save()
    assert len(reads) == 3 and DigestCache(tmp_path / "cache.json").file(path) == "digest" and len(reads) == 3


BASE = CacheKey("s", 1, {"a.x": 1, "a.y": 2.0}, {"photos": "d"}, defaults={"a.x": 1, "a.y": 3.0})


def test_key_is_blake3_of_canonical_json() -> None:
    body = '{"format":1,"inputs":{"photos":"d"},"settings":{"a.y":2.0},"stage":"s","version":1}'
    assert BASE.digest == blake3(body.encode()).hexdigest()


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "t"}, {"version": 2}, {"settings": {"a.x": 2, "a.y": 2.0}}, {"settings": {"a.x": 1, "a.y": 3.0}},
        {"inputs": {"photos": "e"}}, {"inputs": {"photos": "d", "masks": "f"}}, {"backend": "cpu"}, {"seed": 0},
    ],
)  # fmt: skip
def test_every_component_changes_the_key(change: dict[str, object]) -> None:
    assert replace(BASE, **change).digest != BASE.digest  # type: ignore[arg-type]


def test_canonical_json() -> None:
    assert canonical_json({"b": [1, 2.5], "a": "ä"}) == '{"a":"\\u00e4","b":[1,2.5]}'
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json(float("nan"))


def test_settings_view() -> None:
    view = SettingsView(Toy(), ["read.*", "sum.steps"])
    assert view.read.limit == 100 and view.read is not None and view.sum.steps == 10
    for get in (lambda: view.sum.ignored, lambda: view.nothing, lambda: getattr(view.sum, "ignored", None)):
        with pytest.raises(UndeclaredSetting):
            get()
    with pytest.raises(UndeclaredSetting, match=r"'sum.stepz' matches no field"):
        SettingsView(Toy(), ["sum.stepz"])


def test_results_are_converted_to_strict_json(tmp_path: Path) -> None:
    import numpy as np

    given = {"a": np.float32(0.5), "b": np.arange(3), "c": float("nan"), "d": tmp_path, 4: (True, None)}
    assert to_json(given) == {"a": 0.5, "b": [0, 1, 2], "c": None, "d": str(tmp_path), "4": [True, None]}
    with pytest.raises(TypeError):
        to_json({"a": object()})


def test_one_line_joins_and_truncates() -> None:
    assert one_line("a\n  b\tc") == "a b c" and len(one_line("x" * 999)) == 300


def test_thread_environment_sets_every_pool() -> None:
    environment = thread_environment(3)
    pools = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    assert {environment[name] for name in pools} == {"3"}
    assert environment["OMP_WAIT_POLICY"] == "PASSIVE"  # waiting threads must not use processor time
