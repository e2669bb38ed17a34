"""Replacement of a stage's output by the user's files, and undoing it."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbake.errors import BadInputError, UsageError
from gsbake.pipeline.replace import folder_files, replace_output, undo_replacement
from tests.pipeline.toy import engine


def test_later_stages_read_the_replaced_output(tmp_path: Path, photos: Path) -> None:
    out, mine = tmp_path / "out", tmp_path / "mine.txt"
    mine.write_text("777")
    first, _ = engine(out, photos)
    own = first.run()[1].artifact
    assert own is not None
    artifact = replace_output(first.store, "sum", {"total.txt": mine}, own)
    mine.unlink()  # it was copied
    assert artifact.replaced and artifact.manifest["replaced"] == {"total.txt": str(mine)}
    assert artifact.manifest["decisions"][0]["choice"] == "replaced by the user"
    second, seen = engine(out, photos)
    assert [s.status for s in second.plan()] == ["cached", "replaced", "run"]
    assert second.plan()[2].reasons == ("sum: total.txt changed",)
    states = second.run()
    assert seen.ran == ["tell"] and seen.cached == ["read", "sum"]
    assert (states[2].artifact.folder / "tell.txt").read_text() == "total 777"  # type: ignore[union-attr]
    undo_replacement(second.store, "sum")
    third, seen = engine(out, photos)
    third.run()
    assert seen.ran == [] and not list((out / "stages" / "sum").glob("by-hand*"))
    with pytest.raises(UsageError, match="was not replaced"):
        undo_replacement(third.store, "sum")


def test_second_replacement_deletes_the_first_and_keeps_other_files(tmp_path: Path, photos: Path) -> None:
    made, _ = engine(tmp_path / "out", photos)
    made.run()
    folder = tmp_path / "mine"
    (folder / "deep").mkdir(parents=True)
    (folder / "total.txt").write_text("1")
    (folder / "deep" / "more.txt").write_text("more")
    first = replace_output(made.store, "sum", folder_files(folder), None)
    assert set(first.files) == {"total.txt", "deep/more.txt"}
    (tmp_path / "total.txt").write_text("2")
    second = replace_output(made.store, "sum", {"total.txt": tmp_path / "total.txt"}, first)
    assert set(second.files) == {"total.txt", "deep/more.txt"} and (second.folder / "total.txt").read_text() == "2"
    assert len([p for p in (tmp_path / "out" / "stages" / "sum").glob("by-hand-*")]) == 1


def test_damaged_replacement_raises(tmp_path: Path, photos: Path) -> None:
    made, _ = engine(tmp_path / "out", photos)
    made.run()
    (tmp_path / "total.txt").write_text("2")
    artifact = replace_output(made.store, "sum", {"total.txt": tmp_path / "total.txt"}, None)
    (artifact.folder / "total.txt").write_text("3")
    with pytest.raises(BadInputError, match="replace sum --undo"):
        engine(tmp_path / "out", photos)[0].plan()


def test_the_only_copy_of_the_users_files_is_set_aside(tmp_path: Path, photos: Path, finished: Path) -> None:
    """By a second replacement, by undoing it, and where its files were edited in place."""
    made, _ = engine(finished, photos)
    mine = tmp_path / "total.txt"
    aside = finished / "set-aside" / "sum"
    for text in ("first", "second", "third"):
        mine.write_text(text)
        artifact = replace_output(made.store, "sum", {"total.txt": mine}, None)
    assert {path.read_text() for path in aside.rglob("*") if path.is_file()} == {"first", "second"}
    (artifact.folder / "total.txt").write_text("edited in place")
    mine.unlink()
    undo_replacement(made.store, "sum")
    assert {path.read_text() for path in aside.rglob("*") if path.is_file()} == {"first", "second", "edited in place"}
    assert len(made.store.take_moved()) == 3 and made.store.take_moved() == []
    assert not list((finished / "stages" / "sum").glob("by-hand-*"))


def test_files_kept_from_the_stages_own_output_are_not_set_aside(tmp_path: Path, photos: Path, finished: Path) -> None:
    made, _ = engine(finished, photos)
    base = made.run()[1].artifact
    assert base is not None
    extra = tmp_path / "extra.txt"
    extra.write_text("mine")
    replace_output(made.store, "sum", {"extra.txt": extra}, base)
    undo_replacement(made.store, "sum")
    assert [path.name for path in (finished / "set-aside").rglob("*") if path.is_file()] == ["extra.txt"]


def test_names_that_no_manifest_may_have_are_refused(tmp_path: Path, photos: Path, finished: Path) -> None:
    (tmp_path / "mine.txt").write_text("1")
    store = engine(finished, photos)[0].store
    for name in ("a?.txt", "../total.txt", "con", "manifest.json/a", "line\nbreak"):
        with pytest.raises(UsageError, match="rename it"):
            replace_output(store, "sum", {name: tmp_path / "mine.txt"}, None)
    assert not list(store.stage_folder("sum").glob("by-hand*"))
