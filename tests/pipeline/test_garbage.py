"""Garbage collection: what is chosen, what is never touched, and what the command says."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from gsbake.cli.cache import parse_age, parse_size
from gsbake.errors import UsageError
from gsbake.pipeline.garbage import choose, delete, list_entries
from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.pipeline.replace import replace_output
from gsbake.pipeline.store import Store
from tests.pipeline.conftest import WORDS
from tests.pipeline.toy import Read, Toy, artifact, engine

STAGES = ("read", "sum", "tell")


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("garbage")
    (root / "photos").mkdir()
    (root / "photos" / "a.txt").write_text(WORDS)
    engine(root / "out", root / "photos", Toy(read=Read(limit=1)))[0].run()
    for stage in STAGES:
        os.utime(artifact(root / "out", stage), (1.0, 1.0))
    engine(root / "out", root / "photos")[0].run()
    return root / "out"


@pytest.fixture
def store(two_runs: Path, photos: Path, tmp_path: Path) -> Store:
    """Two generations of every stage, the older one last used long ago."""
    shutil.copytree(two_runs, tmp_path / "out", symlinks=True)
    return Store(tmp_path / "out")


def test_old_artifacts_go_and_the_newest_stay(store: Store, photos: Path) -> None:
    entries = list_entries(store, STAGES)
    assert sorted((e.stage, e.newest) for e in entries) == sorted((s, n) for s in STAGES for n in (False, True))
    chosen = choose(entries, older=30 * 86400)
    assert {e.newest for e in chosen} == {False} and len(delete(chosen)) == 3
    assert [s.status for s in engine(store.out, photos)[0].plan()] == ["cached"] * 3


def test_a_size_takes_the_least_recently_used_first(store: Store) -> None:
    entries = list_entries(store, STAGES)
    total = sum(e.size for e in entries)
    one = choose(entries, keep=total - 1)
    assert len(one) == 1 and one[0].used == 1.0
    assert choose(entries, keep=total) == [] and len(choose(entries, keep=0)) == 6


def test_reuse_counts_as_use(store: Store, photos: Path) -> None:
    engine(store.out, photos, Toy(read=Read(limit=1)))[0].run()
    assert all(e.used > 1.0 for e in list_entries(store, STAGES))


def test_leftovers_go_and_the_users_files_stay(store: Store, tmp_path: Path) -> None:
    folder = store.stage_folder("sum")
    (folder / "0123456789abcdef.tmp-00000000").mkdir()
    (folder / "0123456789abcdef.lease").write_text("{")
    mine = tmp_path / "mine.txt"
    mine.write_text("42")
    replace_output(store, "sum", {"total.txt": mine}, None)
    delete(choose(list_entries(store, STAGES), keep=0))
    assert not list(folder.glob("0123*")) and (folder / "replaced.json").exists()
    assert [path.read_text() for path in folder.glob("by-hand-*/total.txt")] == ["42"]


def test_the_cache_of_a_stage_goes_with_age_and_size(store: Store, photos: Path) -> None:
    cache = store.cache("sum")
    (cache / "features").mkdir(parents=True)
    (cache / "features" / "a").write_bytes(bytes(1000))
    os.utime(cache, (1.0, 1.0))
    entry = next(e for e in list_entries(store, ("sum",)) if e.kind == "cache")
    assert entry.size == 1000 and entry in choose([entry], older=86400) and entry in choose([entry], keep=999)
    assert choose([entry], keep=1000) == []
    engine(store.out, photos, Toy(read=Read(limit=2)))[0].run()  # a run of the stage is a use
    assert choose(list_entries(store, ("sum",)), older=86400)[0].kind == "artifact"
    assert delete([entry]) == [entry] and not cache.exists()


def test_what_a_process_works_on_stays(store: Store) -> None:
    entry = list_entries(store, ("sum",))[0]
    lease = Lease(entry.path.with_name(f"{entry.path.name}.lease"))
    lease.acquire()
    lease.path.write_text(lease.path.read_text().replace(str(os.getpid()), str(os.getppid())))
    parent = LeaseHolder.read(lease.path)
    assert parent is not None
    import psutil

    body = {**json.loads(lease.path.read_text()), "started": psutil.Process(os.getppid()).create_time()}
    lease.path.write_text(json.dumps(body))
    assert delete([entry]) == [] and entry.path.is_dir()
    lease.release()


def test_sizes_and_ages() -> None:
    assert [parse_size(x) for x in ("0", "20GB", "1.5 mb")] == [0, 20 * 10**9, 1_500_000]
    assert [parse_age(x) for x in ("12h", "30d", "2w")] == [43_200.0, 2_592_000.0, 1_209_600.0]
    for text in ("", "-1GB", "1e9", "inf", "20 parsecs"):
        with pytest.raises(UsageError):
            parse_size(text)
    with pytest.raises(UsageError):
        parse_age("30")
