"""Names of files that every system accepts, the same on each."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gsbake.batch.captures import BatchOptions, plan_captures
from gsbake.capture.ingest import photo_names
from gsbake.errors import BadInputError, UsageError
from gsbake.system.names import MAX_NAME_BYTES, is_digest, portable_name, same_file_key, unusable_name


@pytest.mark.parametrize("name", ["IMG_0001", "übung 3", "a.b", "console", "com10", "con-1", "[bold]", "photo %00", "写真"])
def test_names_that_stay(name: str) -> None:
    assert portable_name(name) == name


REFUSED = [
    "con", "NUL", "Aux", "com1", "LPT9", "COM²", "nul.left", "con .x", "a:b", "a<b", 'a"b', "a|b", "a?", "a*", "a\\b", "a/b", "dot.",
    "space ", "", "a\nb", "a\x1b[31m", "\x00", "n" * 201, os.fsdecode(b"a\xff"),
]  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_names_that_are_changed(name: str) -> None:
    found = portable_name(name)
    assert found != name and found.isprintable() and len(os.fsencode(found)) <= MAX_NAME_BYTES
    assert not set('<>:"/\\|?*') & set(found) and found[-1] not in ". "
    assert portable_name(found) == found  # also no device of Windows
    assert portable_name(f"{name}2") != found


def test_photos_that_are_one_file_elsewhere(tmp_path: Path) -> None:
    names = photo_names({"left/con.jpg": tmp_path, "aux.png": tmp_path, "a:1.jpg": tmp_path})
    assert names["left/con.jpg"] == "left_con"
    assert names["aux.png"].startswith("_aux_") and names["a:1.jpg"].startswith("a_1_")
    for one, two in (("a.jpg", "A.png"), ("caf\u00e9.jpg", "cafe\u0301.png"), ("stra\u00dfe.jpg", "STRASSE.jpg"), ("l/a.jpg", "L_A.jpg")):
        with pytest.raises(BadInputError, match="would both be called"):
            photo_names({one: tmp_path, two: tmp_path})
    assert same_file_key("a") != same_file_key("b")


def test_captures_that_are_one_folder_elsewhere(tmp_path: Path) -> None:
    for name in ("one/Cup", "two/cup"):
        (tmp_path / name).mkdir(parents=True)
    with pytest.raises(UsageError, match="have the same name 'cup'"):
        plan_captures([tmp_path / "one/Cup", tmp_path / "two/cup"], BatchOptions(tmp_path / "out", "smoke"))


@pytest.mark.parametrize("name", ["asset.glb", "photos/IMG_0001.png", ".hidden/a", "a" * 200 + ".png", "übung/写真.jpg", "a/b/c"])
def test_names_that_may_be_files_of_an_artifact(name: str) -> None:
    assert unusable_name([name, "manifest.json"]) is None


@pytest.mark.parametrize(
    "name",
    ["", ".", "..", "../x", "a/../b", "/etc/passwd", "a//b", "a/", "a\\b", "c:x", "a\x00b", "a\nb", "n" * 256, "n/" * 600 + "n", "con",
     os.fsdecode(b"a\xff"), 7, None, ["a"]],
)  # fmt: skip
def test_names_that_may_not(name: object) -> None:
    found = unusable_name(["asset.glb", name])
    assert found is not None and found.isprintable() and len(found) <= 40


def test_a_file_and_a_folder_of_one_name() -> None:
    assert unusable_name(["a", "a.b", "ab/c"]) is None
    assert unusable_name(["a/b/c", "x", "a/b"]) == "'a/b'"


def test_digests() -> None:
    assert is_digest("0" * 64)
    for wrong in ("", "0" * 63, "0" * 65, "G" * 64, "0" * 64 + "\n", "../home/thesis.odt", 0, None):
        assert not is_digest(wrong)
