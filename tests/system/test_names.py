"""Names of files that every system accepts, the same on each."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gsbake.batch.captures import BatchOptions, plan_captures
from gsbake.capture.ingest import photo_names
from gsbake.errors import BadInputError, UsageError
from gsbake.system.names import MAX_NAME_BYTES, portable_name, same_file_key


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
