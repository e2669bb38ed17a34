"""gsbake writes only into a folder that is new, empty or its own: what is there stays, byte by byte, and nothing is added."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import gsbake
from gsbake.errors import UsageError
from gsbake.synth.folder import MARK
from tests.cli.conftest import Run


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_folder_of_other_files_is_refused(run: Run, capture: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    for name in ("thesis.odt", "asset.glb", "stages/notes.txt", "logs/a.log", "events.jsonl", "digests.json"):
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text("mine")
    before = contents(home)
    for command in (["run", capture], ["mesh", capture, "--dry-run"], ["status", capture]):
        end = run(*command, "--out", home)
        assert end.code == 2 and end.err.count("\n") == 1 and "holds other files" in end.err, command
    with pytest.raises(UsageError, match="holds other files"):
        gsbake.run(capture, out=home)
    assert contents(home) == before


def test_new_empty_and_own_folders_are_taken(run: Run, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / ".DS_Store").write_text("")
    (tmp_path / "empty" / ".project.json.12.0a1b2c3d.tmp").write_text("")  # of a killed run
    assert run("ingest", capture, "--out", "empty").code == 0
    assert run("ingest", capture, "--out", "empty").code == 0
    for name in ("project.json", "digests.json"):
        (tmp_path / "empty" / name).unlink(missing_ok=True)  # which messages advise where the project is damaged
    assert run("ingest", capture, "--out", "empty").code == 0
    (tmp_path / "empty" / "project.json").unlink()
    (tmp_path / "empty" / "holiday.jpg").write_text("mine")
    assert run("ingest", capture, "--out", "empty").code == 2


@pytest.mark.parametrize(
    ("name", "content"), [("digests.json", '{"thesis.odt": "d41d8cd9"}'), ("project.json", "{}"), ("project.json", '{"name": "shop"}')]
)
def test_files_of_other_programs_with_names_of_its_own_are_not_its_mark(
    run: Run, capture: Path, tmp_path: Path, name: str, content: str
) -> None:
    home = tmp_path / "shop"
    home.mkdir()
    (home / name).write_text(content)
    done = run("ingest", capture, "--out", home)
    assert done.code in (2, 42) and "name " in done.err and "delete" not in done.err
    assert contents(home) == {name: content.encode()}


def test_a_run_that_found_no_usable_photos_does_not_block_its_folder(run: Run, capture: Path) -> None:
    assert run("run", capture, "--out", "o", "--set", "ingest.min_photos=9").code == 42
    assert run("ingest", capture, "--out", "o").code == 0


def test_the_demo_lies_around_its_capture(run: Run, capture: Path, tmp_path: Path) -> None:
    demo = tmp_path / "demo"
    shutil.copytree(capture, demo / "capture")
    assert run("ingest", demo / "capture", "--out", demo).code == 2  # a capture of somebody's
    (demo / "capture" / MARK).write_text(json.dumps({"format": 1, "files": {}}))
    assert run("ingest", demo / "capture", "--out", demo).code == 0
    copied = shutil.copytree(demo, tmp_path / "copy" / "demo")
    assert run("ingest", copied / "capture", "--out", copied, "--json").json["stages"][0]["status"] == "cached"


def test_an_output_among_the_photos_is_refused(run: Run, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(tmp_path)
    for arguments in ([capture / "images", "--out", capture / "images" / "out"], [capture, "--out", capture / "masks" / "out"]):
        end = run("run", *arguments)
        assert end.code == 2 and end.err.count("\n") == 1 and "would be read as such" in end.err
    monkeypatch.chdir(capture / "images")
    assert run("run", ".").code == 2
    assert contents(tmp_path) == before
    assert run("ingest", capture, "--out", capture / "out").code == 0  # beside the photos
    stored = shutil.copytree(capture / "images", capture / "out" / "stages" / "ingest" / "mine")
    end = run("run", stored, "--out", capture / "out", "--moved")
    assert end.code == 2 and "among the stored outputs" in end.err


def test_another_capture_of_the_same_name_is_refused(run: Run, capture: Path, tmp_path: Path) -> None:
    run("ingest", capture)
    project = (tmp_path / "out" / "tankard" / "project.json").read_bytes()
    other = shutil.copytree(capture, tmp_path / "b" / "tankard")
    end = run("run", other)
    assert end.code == 2 and end.err.count("\n") == 1 and "--moved" in end.err
    assert str(capture / "images") in end.err and str(other / "images") in end.err
    with pytest.raises(UsageError, match="other photos"):
        gsbake.run(other)
    assert run("plan", other).code == 2 and run("batch", other).code == 2
    assert (tmp_path / "out" / "tankard" / "project.json").read_bytes() == project
    assert run("status", other, "--moved").code == 0 and run("plan", other, "--moved").code == 0
    assert run("ingest", other, "--moved", "--json").json["stages"][0]["status"] == "cached"
    assert run("ingest", other).code == 0 and run("ingest", capture).code == 2


def test_photos_that_merely_moved_are_recognised_where_they_are_gone(run: Run, capture: Path, tmp_path: Path) -> None:
    run("ingest", capture)
    (tmp_path / "b").mkdir()
    moved = capture.rename(tmp_path / "b" / "tankard")
    assert run("ingest", moved).code == 0
    moved = moved.rename(capture)
    (capture / "images" / "a.jpg").write_text("another photo")
    assert run("ingest", capture).code == 2 and run("ingest", capture, "--moved").code == 0


def test_masks_are_written_into_a_new_folder(run: Run, capture: Path, tmp_path: Path) -> None:
    run("ingest", capture, "--out", "o")
    before = contents(capture)
    end = run("masks", capture / "images" / "edit", "--out", "o")
    assert end.code == 2 and "would be read as such" in end.err and contents(capture) == before
