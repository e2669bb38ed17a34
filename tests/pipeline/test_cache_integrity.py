"""The cache is never wrong: planted, damaged and rewritten files, failing flushes, damaged records of replacements and projects."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from gsbake.errors import BadInputError, InterruptedRun
from gsbake.pipeline import files as disk
from gsbake.pipeline import store as store_module
from gsbake.pipeline.digest import list_files
from gsbake.pipeline.garbage import choose, delete, list_entries
from gsbake.pipeline.project import Project
from gsbake.pipeline.replace import replace_output, undo_replacement
from gsbake.pipeline.store import MANIFEST, REPLACEMENT, Store, read_manifest
from tests.pipeline.toy import Sum, Toy, artifact, engine


@pytest.mark.parametrize("name", ["emissive.exr", ".hidden", "sub/planted.txt"])
def test_planted_file_is_set_aside(photos: Path, name: str, finished: Path) -> None:
    out = finished
    planted = artifact(out, "sum") / name
    planted.parent.mkdir(exist_ok=True)
    planted.write_text("stranger")
    states = engine(out, photos)[0].plan()
    assert states[1].status == "run" and any("was added" in reason for reason in states[1].reasons)
    again, recorder = engine(out, photos)
    again.run()
    assert recorder.cached == ["read", "sum", "tell"]
    moved = [path for path in (out / "set-aside").rglob("*") if path.is_file()]
    assert [path.read_text() for path in moved] == ["stranger"] and not planted.exists()


@pytest.mark.parametrize("damage", ["edited", "edited, and its manifest cut off"])
def test_an_output_edited_in_place_is_set_aside(photos: Path, finished: Path, damage: str) -> None:
    """The stage is computed again, as its output is not what the key says, but the edit is not lost."""
    folder = artifact(finished, "sum")
    total = (folder / "total.txt").read_text()
    (folder / "total.txt").write_text("edited by hand")
    if damage != "edited":
        (folder / MANIFEST).write_text("{")
    again, recorder = engine(finished, photos)
    lines: list[str] = []
    recorder.warning = lambda name, text: lines.append(text)  # type: ignore[method-assign]
    again.run()
    assert recorder.ran == ["sum"] and (folder / "total.txt").read_text() == total
    assert (finished / "set-aside" / "sum" / folder.name / "total.txt").read_text() == "edited by hand"
    assert len(lines) == 1 and "total.txt" in lines[0] and "set-aside" in lines[0]
    delete(again.store, choose(list_entries(again.store, ("read", "sum", "tell")), keep=0))
    assert len(list(finished.glob("set-aside/sum/*/total.txt"))) == 1


def test_only_the_artifacts_of_the_run_are_looked_at(tmp_path: Path, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run reads the manifests of what it uses, not those of all settings ever tried; files planted there wait for their turn."""
    out = tmp_path / "out"
    for steps in range(1, 5):
        engine(out, photos, Toy(sum=Sum(steps=steps)))[0].run()
    old = [folder for stage in ("sum", "tell") for folder in Store(out).artifact_folders(stage)]
    for folder in old:
        (folder / "emissive.exr").write_text("stranger")
    read: list[Path] = []

    def recorded(folder: Path) -> dict[str, object] | None:
        read.append(folder)
        return read_manifest(folder)

    monkeypatch.setattr(store_module, "read_manifest", recorded)
    again, recorder = engine(out, photos, Toy(sum=Sum(steps=2)))
    used = {state.artifact.folder for state in again.run() if state.artifact is not None}
    assert recorder.cached == ["read", "sum", "tell"] and set(read) == used and len(used) == 3
    assert {folder for folder in old if (folder / "emissive.exr").exists()} == set(old) - used
    engine(out, photos, Toy(sum=Sum(steps=3)))[0].run()
    assert sum((folder / "emissive.exr").exists() for folder in old) == len(old) - 4


def test_planted_file_in_a_replacement_is_set_aside(tmp_path: Path, photos: Path, finished: Path) -> None:
    out, mine = finished, tmp_path / "mine.txt"
    mine.write_text("42")
    planted = replace_output(Store(out), "sum", {"total.txt": mine}, None).folder / "emissive.exr"
    planted.write_text("stranger")
    engine(out, photos)[0].run()
    assert not planted.exists() and [path.read_text() for path in out.glob("set-aside/sum/*/*")] == ["stranger"]
    assert (artifact(out, "tell") / "tell.txt").exists()


def test_planted_link_to_a_folder_is_set_aside(photos: Path, finished: Path) -> None:
    out = finished
    (artifact(out, "sum") / "etc").symlink_to("/etc")
    engine(out, photos)[0].run()
    assert not os.path.lexists(artifact(out, "sum") / "etc")


def test_file_managers_files_are_ignored(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    (artifact(tmp_path / "out", "sum") / ".DS_Store").write_text("")
    assert [s.status for s in engine(tmp_path / "out", photos)[0].plan()] == ["cached"] * 3


@pytest.mark.parametrize(
    "text", ["", "{", "null", "[]", '{"folder": "../../x"}', '{"folder": "by-hand-zz"}', '{"folder": 5}', '{"folder": "by-hand-00000000"}']
)
def test_damaged_record_of_a_replacement_is_refused(tmp_path: Path, photos: Path, text: str, finished: Path) -> None:
    out, mine = finished, tmp_path / "mine.txt"
    mine.write_text("42")
    store = Store(out)
    replace_output(store, "sum", {"total.txt": mine}, None)
    (out / "stages" / "sum" / REPLACEMENT).write_text(text)
    with pytest.raises(BadInputError, match="replaced output of stage 'sum' is damaged") as caught:
        engine(out, photos)[0].run()
    assert "--undo" in str(caught.value) and "\n" not in str(caught.value)
    assert any(path.read_text() == "42" for path in out.rglob("total.txt"))
    undo_replacement(Store(out), "sum")
    assert engine(out, photos)[0].plan()[1].status == "cached"


def test_missing_record_of_a_replacement_is_refused(tmp_path: Path, photos: Path, finished: Path) -> None:
    out, mine = finished, tmp_path / "mine.txt"
    mine.write_text("42")
    replace_output(Store(out), "sum", {"total.txt": mine}, None)
    (out / "stages" / "sum" / REPLACEMENT).unlink()
    with pytest.raises(BadInputError, match=r"replaced\.json is missing"):
        engine(out, photos)[0].run()


def test_photo_rewritten_while_a_stage_runs(tmp_path: Path, photos: Path) -> None:
    """The key's digest is of bytes that the stage may not have read: nothing is published."""
    out = tmp_path / "out"
    first, recorder = engine(out, photos, Toy(sum=Sum(steps=1)))
    relay = first._relay

    def rewrite(name: str, message: object) -> None:
        relay(name, message)  # type: ignore[arg-type]
        if name == "read":
            (photos / "a.txt").write_text("Four five six seven")

    first._relay = rewrite  # type: ignore[method-assign,assignment]
    with pytest.raises(InterruptedRun, match=r"a\.txt changed while the stage ran"):
        first.run()
    assert recorder.ran == [] and not list(out.glob(f"stages/*/*/{MANIFEST}"))
    second, recorder = engine(out, photos, Toy(sum=Sum(steps=1)))
    second.run()
    assert recorder.ran == ["read", "sum", "tell"]
    assert "four" in (artifact(out, "read") / "words.txt").read_text()


def test_a_failing_flush_is_reported(tmp_path: Path, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"

    def fail(handle: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(disk.os, "fsync", fail)
        with pytest.raises(InterruptedRun, match="input/output error"):
            engine(out, photos)[0].run()
    assert not list(out.glob(f"stages/*/*/{MANIFEST}"))
    engine(out, photos)[0].run()


def test_folders_that_cannot_be_flushed_are_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(handle: int) -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    monkeypatch.setattr(disk.os, "fsync", fail)
    disk.sync(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        disk.sync(tmp_path / "file")


def test_links_to_folders_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    (tmp_path / "masks" / "sub" / "a.png").write_text("")
    (tmp_path / "masks" / "etc").symlink_to("/etc")
    assert list_files(tmp_path / "masks") == ["sub/a.png"]


def test_bytes_flipped_below_the_file_system(tmp_path: Path, photos: Path) -> None:
    """Times and size unchanged: the digest cache does not see it, `verify` does."""
    out = tmp_path / "out"
    first = engine(out, photos)[0]
    first.run()
    target = artifact(out, "sum") / "total.txt"
    entries = first.store.digests._entries
    status = target.stat()
    entries[str(target)] = [
        status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns, first.store.digests.file(target)
    ]  # fmt: skip
    data = bytearray(target.read_bytes())
    data[0] ^= 1
    target.write_bytes(bytes(data))
    after = target.stat()
    entries[str(target)][3:5] = [after.st_mtime_ns, after.st_ctime_ns]  # as if no time had been written
    first.store.digests._changed = True
    first.store.digests.save()
    assert engine(out, photos)[0].plan()[1].status == "cached"
    faults = dict(Store(out).verify("sum"))
    assert any("was modified" in fault for fault in faults[artifact(out, "sum")])


@pytest.mark.parametrize(
    "change", [{"files": {"../../x": {"digest": "0", "bytes": 1}}}, {"files": []}, {"files": {"x": 5}}, {"files": {"x": {"digest": 1}}}]
)
def test_malformed_manifest_is_no_artifact(photos: Path, change: dict[str, object], finished: Path) -> None:
    from gsbake.pipeline.store import _seal

    out = finished
    path = artifact(out, "sum") / MANIFEST
    body = {**json.loads(path.read_text()), **change}
    path.write_text(json.dumps({**body, "seal": _seal(body)}))
    again, recorder = engine(out, photos)
    again.run()
    assert recorder.ran == ["sum"]


@pytest.mark.parametrize(
    "text",
    ['{"photos": 5}', "[]", "null", "5", "{", "", '{"overrides": 3}', '{"seed": "x"}', '{"stranger": 1}', '{"published": {"a": 5}}', "\xff",
     "[" * 100_000],
)  # fmt: skip
def test_damaged_project_is_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / "project.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(BadInputError, match="move it away and give the photos again") as caught:
        Project.load(tmp_path)
    assert "\n" not in str(caught.value)


def test_project_survives_names_of_any_bytes(tmp_path: Path) -> None:
    project = Project(photos="/x/\udcff\n\x1b[31m", overrides=("a.b=1",), seed=3, published={"asset.glb": "0"})
    project.save(tmp_path)
    assert Project.load(tmp_path) == project


def test_output_of_an_accepted_run_only_is_remembered(tmp_path: Path) -> None:
    """A run whose inputs cannot be read leaves no trace in the project."""
    called: list[int] = []
    missing, _ = engine(tmp_path / "out", tmp_path / "nothing")
    with pytest.raises(BadInputError):
        missing.run(on_accepted=lambda: called.append(1))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.txt").write_text("x")
    engine(tmp_path / "out", tmp_path / "photos")[0].run(on_accepted=lambda: called.append(2))
    assert called == [2]
    shutil.rmtree(tmp_path / "out")
