"""Folders that are no shared store, and what else lies in one: nothing of it is ever written, deleted or read."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsbake.errors import UsageError
from gsbake.pipeline.shared_store import SharedStore, open_shared_store
from gsbake.pipeline.store_files import StoreFiles
from tests.pipeline.test_shared_store import artifacts, bake, store
from tests.pipeline.toy import engine
from tests.support.slow import slow

OLD = 1.0  # seconds since the epoch
HEX = "0123456789abcdef" * 4


@pytest.fixture(params=["folder", "memory", slow("object server"), slow("SSH server")])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "folder":
        yield str(tmp_path / "shared")
    elif request.param == "memory":
        yield f"memory://{uuid.uuid4().hex}"
    elif request.param == "SSH server":
        yield request.getfixturevalue("ssh").url(tmp_path / "shared")
    else:
        yield f"{request.getfixturevalue('s3')}/{tmp_path.name}"


def snapshot(folder: Path) -> dict[str, tuple[str, int]]:
    """{name: (content or target of a link, time of the last change)} of everything in a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        content = os.readlink(path) if path.is_symlink() else path.read_bytes().hex() if path.is_file() else ""
        found[str(path.relative_to(folder))] = (content, path.lstat().st_mtime_ns)
    return found


def plant(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"mine: {name}")
        os.utime(path, (OLD, OLD))


LOOK_ALIKES = {
    "home": ("tmp/thesis.odt", "Documents/a.txt", "ac/ca.pem", "cas/photo.jpg"),
    "bazel": (f"ac/01/{HEX}", f"cas/01/{HEX}", "tmp/3f0"),
    "tmp alone": ("tmp/" + "a" * 32,),
    "names of a store, without its entries": (f"ac/mesh/{HEX}.json", f"cas/01/{HEX}", "tmp/" + "b" * 32),
    "another store.json": ("store.json",),
}


@pytest.mark.parametrize("names", LOOK_ALIKES.values(), ids=LOOK_ALIKES)
def test_a_folder_that_is_no_store_is_refused_and_left_alone(tmp_path: Path, photos: Path, names: tuple[str, ...]) -> None:
    folder = tmp_path / "home"
    plant(folder, *names)
    before = snapshot(folder)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    key, artifact = artifacts(tmp_path / "other", 1)[0]
    commands = (
        lambda s: s.entries(), lambda s: s.size(), lambda s: s.verify(scratch), lambda s: s.collect_garbage(0, grace=0.0),
        lambda s: s.collect_garbage(0, grace=0.0, dry_run=True), lambda s: s.set_quota(5, scratch), lambda s: s.put(artifact),
        lambda s: s.fetch(key, scratch),
    )  # fmt: skip
    for command in commands:
        with pytest.raises(UsageError, match="is not empty and no shared store of gsbake") as caught:
            command(store(str(folder)))
        assert "\n" not in str(caught.value) and "--store" in str(caught.value)
    made, recorder = engine(tmp_path / "out", photos)
    made.shared = open_shared_store(str(folder))
    with pytest.raises(UsageError, match="no shared store"):
        made.run()
    assert not recorder.ran and not (tmp_path / "out").exists()  # before anything was computed
    assert snapshot(folder) == before


def test_a_file_is_no_store(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="is a file"):
        store(str(tmp_path / "notes.txt")).require()


def unmark(shared: SharedStore, quota: int | None = None) -> None:
    """Make a store as earlier versions made them."""
    path = shared.files.path("store.json")
    shared.files.system.rm_file(path)
    if quota is not None:
        shared.files.system.pipe_file(path, json.dumps({"quota_bytes": quota}).encode())


def marker_of(url: str) -> dict[str, object]:
    found = store(url)
    content: dict[str, object] = json.loads(found.files.system.cat_file(found.files.path("store.json")))
    return content


def test_a_missing_or_empty_folder_becomes_a_store_at_the_first_write(url: str, tmp_path: Path) -> None:
    key, artifact = artifacts(tmp_path / "other", 1)[0]
    (tmp_path / "shared").mkdir()  # empty: nothing before the first write
    assert store(url).entries() == [] and store(url).collect_garbage(0) == (0, 0) and store(url).fetch(key, tmp_path) is None
    assert not list((tmp_path / "shared").iterdir())
    assert store(url).put(artifact) is None and not store(url).notices
    assert marker_of(url) == {"kind": "gsbake shared store", "quota_bytes": None}
    assert len(store(url).entries()) == 1


def test_a_store_of_an_earlier_version_is_read_and_marked_when_it_is_written(url: str, tmp_path: Path) -> None:
    made = artifacts(tmp_path / "other", 2)
    assert store(url).put(made[0][1]) is None
    unmark(store(url), quota=10**9)
    (tmp_path / "fetched").mkdir()
    reader = store(url)
    assert reader.fetch(made[0][0], tmp_path / "fetched") is not None and len(store(url).entries()) == 1
    assert store(url).collect_garbage(0, dry_run=True)[1] == 0 and "kind" not in marker_of(url)
    assert reader.put(made[1][1]) is None
    assert marker_of(url) == {"kind": "gsbake shared store", "quota_bytes": 10**9} and store(url).quota() == 10**9
    assert len(reader.notices) == 1 and "marked as a store" in reader.notices[0]
    assert len(store(url).entries()) == 2 and not store(url).notices


def test_a_run_says_in_one_line_that_it_marked_a_store(tmp_path: Path, photos: Path) -> None:
    shared = str(tmp_path / "shared")
    bake(tmp_path / "one", photos, shared)
    unmark(store(shared))
    assert bake(tmp_path / "two", photos, shared)[2] == []  # only read
    warnings = bake(tmp_path / "three", photos, shared, seed=4)[2]
    assert len(warnings) == 1 and "earlier version" in warnings[0] and (tmp_path / "shared" / "store.json").exists()


@pytest.mark.parametrize("name", ["notes.txt", "ac/sum/notes.txt", "cas/00/notes.txt", "tmp/notes.txt", f"cas/00/{HEX}", "ac/sum/x/y.json"])
def test_an_earlier_store_with_anything_else_in_it_is_not_recognised(tmp_path: Path, name: str) -> None:
    shared = tmp_path / "shared"
    store(str(shared)).put(artifacts(tmp_path / "other", 1)[0][1])
    unmark(store(str(shared)))
    plant(shared, name)
    with pytest.raises(UsageError, match="no shared store"):
        store(str(shared)).collect_garbage(0, grace=0.0)
    assert (shared / name).read_text() == f"mine: {name}" and len(list((shared / "ac").rglob("*.json"))) >= 1


def test_an_earlier_store_that_may_only_be_read_is_read(tmp_path: Path, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = str(tmp_path / "shared")
    bake(tmp_path / "one", photos, shared)
    unmark(store(shared))
    blob = next(path for path in (tmp_path / "shared" / "cas").rglob("*") if path.is_file())
    blob.write_text("damaged")
    before = snapshot(tmp_path / "shared")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", shared)

    monkeypatch.setattr(StoreFiles, "write", refuse)
    monkeypatch.setattr(StoreFiles, "mark_used", lambda *_: None)
    ran = bake(tmp_path / "two", photos, shared)[1].ran
    assert len(ran) == 1 and snapshot(tmp_path / "shared") == before


FOREIGN = (
    "notes.txt", "ac/notes.txt", "ac/sum/notes.json", f"ac/sum/{HEX}", f"ac/sum/{HEX.upper()}.json", "ac/sum/.notes/a", "cas/notes.txt",
    f"cas/ff/{HEX}", "tmp/thesis.odt", "tmp/" + "a" * 31, "tmp/deep/" + "a" * 32,
)  # fmt: skip


def test_other_files_in_a_store_are_left_alone_and_not_counted(tmp_path: Path) -> None:
    shared, scratch = tmp_path / "shared", tmp_path / "scratch"
    scratch.mkdir()
    artifact = artifacts(tmp_path / "other", 1)[0][1]
    store(str(shared)).put(artifact)
    size = store(str(shared)).size()
    plant(shared, *FOREIGN)
    before = snapshot(shared)
    found = store(str(shared)).verify(scratch)
    assert (found.entries, found.blobs, found.damaged) == (1, 1, []) and store(str(shared)).size() == size
    assert len(store(str(shared)).entries()) == 1
    assert store(str(shared)).collect_garbage(0, grace=0.0, dry_run=True) == (size, 0)
    assert snapshot(shared) == before  # neither written nor deleted
    assert store(str(shared)).collect_garbage(0, grace=0.0) == (size, 0)
    assert {name for name in FOREIGN if (shared / name).is_file()} == set(FOREIGN) and not list((shared / "ac" / "sum").glob("*[0-9].json"))


def test_looking_deletes_nothing_that_is_damaged(tmp_path: Path) -> None:
    shared, scratch = tmp_path / "shared", tmp_path / "scratch"
    scratch.mkdir()
    key, artifact = artifacts(tmp_path / "other", 1)[0]
    store(str(shared)).put(artifact)
    (shared / "ac" / "sum" / f"{key.digest}.json").write_text("{")
    before = snapshot(shared)
    assert store(str(shared)).entries() == [] and store(str(shared)).verify(scratch).damaged
    store(str(shared)).collect_garbage(0, dry_run=True, grace=0.0)
    assert snapshot(shared) == before
    store(str(shared)).collect_garbage(None, grace=0.0)
    assert not list((shared / "ac").rglob("*.json")) and not [path for path in (shared / "cas").rglob("*") if path.is_file()]


def test_links_in_a_store_lead_nowhere(tmp_path: Path) -> None:
    shared, home, scratch = tmp_path / "shared", tmp_path / "home", tmp_path / "scratch"
    scratch.mkdir()
    made = artifacts(tmp_path / "other", 3)
    for _, artifact in made:
        store(str(shared)).put(artifact)
    # an entry, a folder of entries, a folder of blobs and a blob lie elsewhere now
    home.mkdir()
    entry = shared / "ac" / "sum" / f"{made[0][0].digest}.json"
    shutil.move(entry, home / "entry.json")
    entry.symlink_to(home / "entry.json")
    digest = made[1][1].files["total.txt"]
    blob = shared / "cas" / digest[:2] / digest
    shutil.move(blob, home / "blob")
    blob.symlink_to(home / "blob")
    digest = made[2][1].files["total.txt"]
    shutil.move(shared / "cas" / digest[:2], home / "blobs")
    (shared / "cas" / digest[:2]).symlink_to(home / "blobs", target_is_directory=True)
    plant(home, f"mesh/{HEX}.json", HEX)
    (shared / "ac" / "mesh").symlink_to(home / "mesh", target_is_directory=True)
    (shared / "tmp" / ("a" * 32)).symlink_to(home / HEX)
    before = snapshot(home)
    for number, (key, artifact) in enumerate(made):
        (tmp_path / f"fetched{number}").mkdir()
        assert store(str(shared)).fetch(key, tmp_path / f"fetched{number}") is None
        if number < 2:  # the links are replaced, not what they lead to
            assert store(str(shared)).put(artifact) is None
            (tmp_path / f"again{number}").mkdir()
            assert store(str(shared)).fetch(key, tmp_path / f"again{number}") is not None
    assert not entry.is_symlink() and not blob.is_symlink()
    assert all(size < 100 for size in store(str(shared)).collect_garbage(0, grace=0.0))
    assert snapshot(home) == before


@pytest.mark.parametrize("name", ["ac", "cas", "tmp"])
def test_a_store_whose_folders_are_links_is_refused(tmp_path: Path, name: str) -> None:
    shared = tmp_path / "shared"
    store(str(shared)).put(artifacts(tmp_path / "other", 1)[0][1])
    shutil.move(shared / name, tmp_path / "elsewhere")
    (shared / name).symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    before = snapshot(tmp_path)
    with pytest.raises(UsageError, match=f"'{name}' in the shared store .* is a link"):
        store(str(shared)).collect_garbage(0, grace=0.0)
    assert snapshot(tmp_path) == before


def test_a_marker_that_was_cut_off_is_written_again(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    (shared / "store.json").write_text('{"kind": "gsb')
    assert store(str(shared)).put(artifacts(tmp_path / "other", 1)[0][1]) is None
    assert marker_of(str(shared))["kind"] == "gsbake shared store"
