"""Garbage collection: what is chosen, what is never touched, and what the command says."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from dataclasses import asdict, replace
from pathlib import Path

import psutil
import pytest

from gsbake.cli.cache import parse_age, parse_size
from gsbake.errors import UsageError
from gsbake.pipeline.garbage import choose, delete, list_entries
from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.pipeline.replace import replace_output
from gsbake.pipeline.store import Store
from gsbake.pipeline.uses import Uses, in_use
from gsbake.python_process import python_command, python_environment
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
    assert {e.newest for e in chosen} == {False} and len(delete(store, chosen)) == 3
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
    delete(store, choose(list_entries(store, STAGES), keep=0))
    assert not list(folder.glob("0123*")) and (folder / "replaced.json").exists()
    assert [path.read_text() for path in folder.glob("by-hand-*/total.txt")] == ["42"]


def test_files_that_were_edited_are_set_aside(store: Store) -> None:
    old = next(e for e in choose(list_entries(store, STAGES), older=30 * 86400) if e.stage == "sum")
    name = next(name for name in sorted(p.name for p in old.path.iterdir()) if name != "manifest.json")
    (old.path / name).write_text("edited by hand")
    (old.path / "note.txt").write_text("added by hand")
    assert delete(store, [old]) == [old]
    aside = store.out / "set-aside" / "sum" / old.path.name
    assert sorted(store.take_moved()) == sorted([aside / name, aside / "note.txt"])
    assert (aside / name).read_text() == "edited by hand" and (aside / "note.txt").read_text() == "added by hand"


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
    assert delete(store, [entry]) == [entry] and not cache.exists()


def test_what_a_process_works_on_stays(store: Store) -> None:
    entry = list_entries(store, ("sum",))[0]
    lease = Lease(entry.path.with_name(f"{entry.path.name}.lease"))
    lease.acquire()
    lease.path.write_text(lease.path.read_text().replace(str(os.getpid()), str(os.getppid())))
    parent = LeaseHolder.read(lease.path)
    assert parent is not None
    body = {**json.loads(lease.path.read_text()), "started": psutil.Process(os.getppid()).create_time()}
    lease.path.write_text(json.dumps(body))
    assert delete(store, [entry]) == [] and entry.path.is_dir()
    lease.release()


def test_sizes_and_ages() -> None:
    assert [parse_size(x) for x in ("0", "20GB", "1.5 mb")] == [0, 20 * 10**9, 1_500_000]
    assert [parse_age(x) for x in ("12h", "30d", "2w")] == [43_200.0, 2_592_000.0, 1_209_600.0]
    for text in ("", "-1GB", "1e9", "inf", "20 parsecs"):
        with pytest.raises(UsageError):
            parse_size(text)
    with pytest.raises(UsageError):
        parse_age("30")


FOREIGN = (
    "scan.tmp-keep/a", "model-final.checkpoint/a", "0123456789abcdef.tmp-keep/a", "0123456789abcde.tmp-00000000/a", "by-hand.tmp-mine/a",
    "by-hand-00000000/a", "0123456789ABCDEF/a", "backup.lease", "caches/a", ".0123456789abcdef.mine.tmp", ".0123456789abcdef.tmp",
)  # fmt: skip


def test_names_that_gsbake_does_not_give_stay(store: Store) -> None:
    folder = store.stage_folder("sum")
    for name in FOREIGN:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("mine")
    entries = list_entries(store, STAGES)
    assert not {name.split("/")[0] for name in FOREIGN} & {entry.path.name for entry in entries}
    delete(store, choose(entries, keep=0, older=0.0))
    store.remove_leftovers("sum", "0123456789abcdef" * 4)
    store.remove_leftovers("sum", "by-hand")
    assert [name for name in FOREIGN if (folder / name).read_text() == "mine"] == list(FOREIGN)
    assert not any(e.kind == "artifact" for e in list_entries(store, STAGES))


@pytest.mark.parametrize("link", ["stages", "stages/sum"])
def test_nothing_behind_a_link_is_deleted(store: Store, tmp_path: Path, link: str) -> None:
    leftovers = ("0123456789abcdef.tmp-00000000", "0123456789abcdef.checkpoint", "cache")
    for name in leftovers:
        (store.stage_folder("sum") / name).mkdir()
    shutil.move(store.out / link, tmp_path / "elsewhere")
    (store.out / link).symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    before = sorted(tmp_path.joinpath("elsewhere").rglob("*"))
    delete(store, choose(list_entries(store, ("sum",)), keep=0, older=0.0))
    store.remove_leftovers("sum", "0123456789abcdef" * 4)
    assert sorted(tmp_path.joinpath("elsewhere").rglob("*")) == before


def test_a_link_with_a_name_of_gsbake_stays(store: Store, tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "a").write_text("mine")
    for name in ("0123456789abcdef", "0123456789abcdef.tmp-00000000", "0123456789abcdef.checkpoint", "cache"):
        (store.stage_folder("sum") / name).symlink_to(tmp_path / "scans", target_is_directory=True)
    delete(store, choose(list_entries(store, STAGES), keep=0))
    store.remove_leftovers("sum", "0123456789abcdef" * 4)
    assert (tmp_path / "scans" / "a").exists() and (store.stage_folder("sum") / "cache").is_symlink()


def test_what_a_running_stage_reads_stays(tmp_path: Path, photos: Path) -> None:
    """Until its run ends, because later stages may read it too."""
    out = tmp_path / "out"
    command = python_command("-c", "from tests.pipeline.toy import main; main()", str(out), str(photos), "chain", "40", "0.05")
    with subprocess.Popen(command, env=python_environment(), stdout=subprocess.PIPE) as process:
        deadline = time.monotonic() + 60
        while not list(out.glob("stages/sum/*.checkpoint/state.json")) and time.monotonic() < deadline:
            time.sleep(0.02)
        used = Store(out)
        entries = list_entries(used, STAGES)
        kept = artifact(out, "read")
        assert [e.in_use for e in entries if e.kind == "artifact"] == [True]
        assert kept not in {e.path for e in choose(entries, keep=0, older=0.0)}
        assert not delete(used, entries) and kept.is_dir()  # whatever is chosen
        assert process.communicate()[0] and process.returncode == 0
    assert not (out / "running").exists() and not any(e.in_use for e in list_entries(used, STAGES))
    assert len(delete(used, choose(list_entries(used, STAGES), keep=0))) == 3


def test_a_use_that_begins_after_the_choice_counts(store: Store) -> None:
    entry = next(e for e in list_entries(store, ("sum",)) if e.kind == "artifact")
    with Uses(store.out) as uses:
        assert uses.add(entry.path) and delete(store, [entry]) == [] and entry.path.is_dir()
    assert delete(store, [entry]) == [entry]


def test_a_run_does_not_use_what_another_process_may_be_deleting(store: Store, photos: Path) -> None:
    """It takes the lease, and looks again."""
    entry = next(e for e in list_entries(store, ("sum",)) if e.newest)
    process = psutil.Process(os.getppid())
    holder = replace(LeaseHolder.current(), pid=process.pid, started=process.create_time())
    lease = entry.path.with_name(f"{entry.path.name}.lease")
    lease.write_text(json.dumps(asdict(holder)))
    with Uses(store.out) as uses:
        assert not uses.add(entry.path)
    run, recorder = engine(store.out, photos)

    def deleted(name: str, held_by: LeaseHolder | None) -> None:
        shutil.rmtree(entry.path)
        lease.unlink()

    recorder.stage_waiting = deleted  # type: ignore[assignment,method-assign]
    run.run()
    assert recorder.ran == ["sum"] and recorder.cached == ["read", "tell"]


def test_files_of_killed_runs_do_not_count(store: Store) -> None:
    entry = list_entries(store, ("sum",))[0]
    holder = asdict(replace(LeaseHolder.current(), started=1.0))
    folder = store.out / "running"
    folder.mkdir()
    for number, text in enumerate((json.dumps({**holder, "uses": [entry.name]}), "{", "[" * 100_000)):
        (folder / f"{number:032x}.json").write_text(text)
        os.utime(folder / f"{number:032x}.json", (1.0, 1.0))
    half = folder / f".{7:032x}.json.17.0123abcd.tmp"
    half.write_text("{")
    os.utime(half, (1.0, 1.0))
    (folder / "notes.json").write_text("mine")
    assert not in_use(store.out) and delete(store, [entry]) == [entry]
    assert [path.name for path in folder.iterdir()] == ["notes.json"]
    elsewhere = {**holder, "host": "elsewhere", "uses": ["sum/x"]}
    (folder / f"{9:032x}.json").write_text(json.dumps(elsewhere))
    assert in_use(store.out) == {"sum/x"}  # its heartbeat was a moment ago
