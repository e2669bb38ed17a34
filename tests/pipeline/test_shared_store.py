"""The shared store: machines reuse each other's stages, damage is found, and nothing that is half there counts."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from gsbake.errors import UsageError
from gsbake.pipeline.engine import Engine
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.shared_store import SharedStore, open_shared_store
from gsbake.pipeline.store import Artifact, Store
from gsbake.pipeline.store_files import StoreFiles
from gsbake.python_process import python_command, python_environment
from tests.pipeline.toy import Recorder, Sum, Toy, engine
from tests.support.slow import slow


def bake(out: Path, photos: Path, url: str, seed: int = 0, patience: float = 0.5) -> tuple[Engine, Recorder, list[str]]:
    """Run the toy pipeline with a shared store; the engine, its recorder and the warnings."""
    made, recorder = engine(out, photos, seed=seed)
    warnings: list[str] = []
    recorder.warning = lambda name, text: warnings.append(text)  # type: ignore[method-assign]
    made.shared = open_shared_store(url, patience)
    made.run()
    return made, recorder, warnings


def store(url: str) -> SharedStore:
    found = open_shared_store(url, 0.5)
    assert found is not None
    return found


def files(folder: Path) -> dict[str, bytes]:
    """{name: bytes} of the artifacts in an output folder, without manifests."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in (folder / "stages").rglob("*.txt")
        if ".lease" not in path.name and path.is_file()
    }


@pytest.mark.parametrize("url", ["folder", "object server", slow("SSH server")], indirect=True)
def test_a_second_machine_computes_nothing(url: str, photos: Path, tmp_path: Path) -> None:
    _, first, _ = bake(tmp_path / "one", photos, url)
    _, second, warnings = bake(tmp_path / "two", photos, url)
    assert first.ran == ["read", "sum", "tell"] and second.ran == [] and second.cached == ["read", "sum", "tell"] and not warnings
    assert files(tmp_path / "one") == files(tmp_path / "two")
    _, other, _ = bake(tmp_path / "three", photos, url, seed=1)
    assert other.ran == ["sum", "tell"]  # the words are the same


def test_what_was_computed_without_the_store_is_shared_later(url: str, photos: Path, tmp_path: Path) -> None:
    engine(tmp_path / "one", photos)[0].run()
    bake(tmp_path / "one", photos, url)
    assert bake(tmp_path / "two", photos, url)[1].ran == []


def test_two_machines_with_other_bytes_for_one_key_agree(url: str, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bake(tmp_path / "one", photos, url)
    made, recorder = engine(tmp_path / "two", photos)
    shared = made.shared = store(url)
    fetch = shared.fetch
    asked: list[str] = []

    def late(cache_key: Any, *arguments: Any) -> Any:
        """The other machine's entry appears only after this one has computed its own."""
        asked.append(cache_key.stage)
        return None if asked.count(cache_key.stage) == 1 else fetch(cache_key, *arguments)

    execute = made._execute

    def differently(stage: Any, *arguments: Any) -> Any:
        """A stage whose bytes differ from run to run."""
        publish = made.store.publish

        def publish_changed(temporary: Path, final: Path, manifest: Any) -> Any:
            for path in temporary.glob("total.txt"):
                path.write_text("another total")
            return publish(temporary, final, manifest)

        with monkeypatch.context() as patch:
            patch.setattr(made.store, "publish", publish_changed)
            return execute(stage, *arguments)

    monkeypatch.setattr(shared, "fetch", late)
    monkeypatch.setattr(made, "_execute", differently)
    made.run()
    assert recorder.ran == ["read", "sum", "tell"] and files(tmp_path / "one") == files(tmp_path / "two")


def artifacts(out: Path, count: int) -> list[tuple[CacheKey, Artifact]]:
    """Artifacts of one file each, with their keys."""
    local, made = Store(out), []
    for number in range(count):
        key = CacheKey("sum", 1, {}, {"words": str(number)})
        temporary = local.temporary("sum", key.digest)
        (temporary / "total.txt").write_text(f"total {number}")
        manifest = {"stage": "sum", "key": key.digest, "settings": {}}
        made.append((key, local.publish(temporary, local.folder("sum", key.digest), manifest)))
    return made


def plant_damage(paths: list[Path], rng: random.Random) -> None:
    """Truncate, flip a bit of, or lengthen each file in turn."""
    for number, path in enumerate(paths):
        content = bytearray(path.read_bytes())
        position = rng.randrange(len(content))
        content[position] ^= 1 << rng.randrange(8)
        path.write_bytes((bytes(content), path.read_bytes()[:position], path.read_bytes() + b"\0")[number % 3])


def test_fifty_corruptions_are_found_and_replaced(tmp_path: Path) -> None:
    shared, rng = tmp_path / "shared", random.Random(5)
    made = artifacts(tmp_path / "out", 60)
    for _, artifact in made:
        assert store(str(shared)).put(artifact) is None
    chosen = []
    for number, (key, artifact) in enumerate(made[:50]):  # the entry or the file of each
        digest = artifact.files["total.txt"]
        chosen.append(shared / (f"ac/sum/{key.digest}.json" if number % 2 else f"cas/{digest[:2]}/{digest}"))
    plant_damage(chosen, rng)
    names = {str(path.relative_to(shared)) for path in chosen}
    found = store(str(shared)).verify(tmp_path)
    assert set(found.damaged) >= names and len(set(found.damaged) - names) <= 25  # an entry goes with its file
    assert set(store(str(shared)).verify(tmp_path).damaged) == set(found.damaged)  # nothing was deleted
    seen: set[str] = set()
    for number, (key, artifact) in enumerate(made):
        reader, folder = store(str(shared)), tmp_path / f"fetched{number}"
        folder.mkdir()
        intact = reader.fetch(key, folder) is not None
        assert intact == (number >= 50)
        seen |= set(reader.damaged)
        if not intact:
            assert reader.put(artifact) is None
    assert seen >= names and not store(str(shared)).verify(tmp_path).damaged


@pytest.mark.parametrize("entry_too", [False, True])
def test_all_damage_of_an_artifact_is_replaced_at_once(url: str, tmp_path: Path, entry_too: bool) -> None:
    """Also where its size is right, and nothing has read the file."""
    key, local = CacheKey("sum", 1, {}, {"words": "w"}), Store(tmp_path / "out")
    temporary = local.temporary("sum", key.digest)
    for name in "abc":
        (temporary / name).write_text(f"the words of {name}")
    made = local.publish(temporary, local.folder("sum", key.digest), {"stage": "sum", "key": key.digest, "settings": {}})
    assert store(url).put(made) is None
    damaged = store(url)
    for name in "abc":
        digest = made.files[name]
        damaged.files.system.pipe_file(damaged.files.path(f"cas/{digest[:2]}/{digest}"), f"the wards of {name}".encode())
    if entry_too:
        damaged.files.system.pipe_file(damaged.files.path(f"ac/sum/{key.digest}.json"), b"{")
    reader = store(url)
    (tmp_path / "one").mkdir()
    assert reader.fetch(key, tmp_path / "one") is None and reader.put(made) is None
    assert len(reader.damaged) == 4
    (tmp_path / "two").mkdir()
    assert store(url).fetch(key, tmp_path / "two") is not None
    (tmp_path / "scratch").mkdir()
    assert not store(url).verify(tmp_path / "scratch").damaged


def test_a_run_computes_damaged_stages_again(photos: Path, tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    bake(tmp_path / "one", photos, str(shared))
    plant_damage(sorted(path for path in (shared / "cas").rglob("*") if path.is_file()), random.Random(1))
    _, recorder, warnings = bake(tmp_path / "two", photos, str(shared))
    assert recorder.ran == ["read", "sum", "tell"] and files(tmp_path / "two") == files(tmp_path / "one")
    assert len(warnings) == 3 and all("damaged and thrown away" in text for text in warnings)
    assert bake(tmp_path / "three", photos, str(shared))[1].ran == []


def test_puts_that_are_killed_leave_nothing_that_counts(url: str, photos: Path, tmp_path: Path) -> None:
    engine(tmp_path / "one", photos)[0].run()
    script = (
        "import sys; from pathlib import Path; from gsbake.pipeline.shared_store import open_shared_store\n"
        "from tests.pipeline.toy import engine\n"
        "made, _ = engine(Path(sys.argv[1]), Path(sys.argv[2])); made.shared = open_shared_store(sys.argv[3], 5.0)\n"
        "print('ready', flush=True); made.run()\n"
    )
    for delay in (0.02, 0.06):
        command = python_command("-c", script, str(tmp_path / "one"), str(photos), url)
        with subprocess.Popen(command, env=python_environment(), stdout=subprocess.PIPE) as process:
            assert process.stdout is not None and process.stdout.readline()
            time.sleep(delay)
            os.kill(process.pid, signal.SIGKILL)
        fresh = tmp_path / f"fresh{delay}"
        _, _, warnings = bake(fresh, photos, url)
        assert files(fresh) == files(tmp_path / "one") and not warnings
    assert not store(url).verify(tmp_path).damaged


def test_a_store_that_may_only_be_read(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = str(tmp_path / "shared")
    bake(tmp_path / "one", photos, shared)
    before = sorted((tmp_path / "shared").rglob("*"))

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", shared)

    monkeypatch.setattr(StoreFiles, "write", refuse)
    assert bake(tmp_path / "two", photos, shared)[1].ran == []
    _, recorder, warnings = bake(tmp_path / "three", photos, shared, seed=3)
    assert recorder.ran == ["sum", "tell"] and sorted((tmp_path / "shared").rglob("*")) == before and not warnings


def test_quota_and_garbage(url: str, photos: Path, tmp_path: Path) -> None:
    bake(tmp_path / "one", photos, url)
    found = store(url)
    entries, size = found.entries(), found.size()
    assert [e.stage for e in entries] == ["read", "sum", "tell"] and size == sum(e.size for e in entries)
    found.set_quota(size, tmp_path)
    assert store(url).quota() == size
    _, recorder, warnings = bake(tmp_path / "two", photos, url, seed=2)
    assert recorder.ran == ["sum", "tell"] and any("it is full" in text for text in warnings) and store(url).size() == size
    assert store(url).collect_garbage(0, dry_run=True) == (size, 0) and store(url).size() == size
    last = store(url).entries()[-1]
    assert store(url).collect_garbage(last.size)[1] == last.size
    assert [e.key for e in store(url).entries()] == [last.key]
    store(url).set_quota(None, tmp_path)
    assert bake(tmp_path / "three", photos, url)[1].cached == [last.stage]


def test_a_store_that_does_not_answer_is_given_up_and_one_that_comes_back_is_used(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, recorder = engine(tmp_path / "one", photos)
    made.shared = found = store(str(tmp_path / "shared"))
    broken = threading.Event()
    read = found.files.system.cat_file
    calls: list[str] = []

    def unreachable(path: str) -> bytes:
        calls.append(path)
        if broken.is_set() or len(calls) == 1:
            raise ConnectionError("the network is down")
        return bytes(read(path))

    monkeypatch.setattr(found.files.system, "cat_file", unreachable)
    made.run()
    assert len(store(str(tmp_path / "shared")).entries()) == 3 and made.shared is not None  # it came back
    broken.set()
    other, recorder = engine(tmp_path / "two", photos, Toy(sum=Sum(steps=3)))
    other.shared = store(str(tmp_path / "shared"))
    monkeypatch.setattr(other.shared.files.system, "cat_file", unreachable)
    other.run()
    assert recorder.ran == ["read", "sum", "tell"] and other.shared is None


def test_leftovers_of_killed_uploads_are_deleted(tmp_path: Path) -> None:
    (_, artifact), shared = artifacts(tmp_path / "out", 1)[0], tmp_path / "shared"
    store(str(shared)).put(artifact)
    orphan = shared / "cas" / "00" / ("0" * 64)
    for path in (shared / "tmp" / ("1" * 32), orphan):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("half")
    assert store(str(shared)).collect_garbage(None)[0] == 0 and orphan.exists()  # an entry may be about to name it
    assert store(str(shared)).collect_garbage(None, grace=0.0)[0] == 4
    assert not orphan.exists() and not list((shared / "tmp").iterdir()) and len(store(str(shared)).entries()) == 1


def test_the_first_entry_stays_also_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (key, artifact), shared = artifacts(tmp_path / "out", 1)[0], tmp_path / "shared"
    entry = shared / "ac" / "sum" / f"{key.digest}.json"
    entry.parent.mkdir(parents=True)
    entry.write_text("the first")
    found = store(str(shared))
    found.files.write(artifact.folder / "manifest.json", f"ac/sum/{key.digest}.json", exclusive=True)
    assert entry.read_text() == "the first"
    entry.unlink()

    def refuse(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    shutil.rmtree(shared)
    found = store(str(shared))
    assert found.put(artifact) is None and found.digest_of(key) == artifact.digest


@pytest.mark.parametrize("wrong", ["ftp://x/y", "http://x/y"])
def test_other_kinds_of_stores_are_refused(wrong: str) -> None:
    with pytest.raises(UsageError, match="file, s3 or sftp"):
        open_shared_store(wrong)
