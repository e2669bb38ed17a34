"""Names made to hurt: terminal control sequences, line breaks, quotes, HTML, marks that reverse the direction of writing, bytes that are no
text, 255 bytes, console markup. Nothing of them reaches the terminal, the events or the report as it is; JSON holds the exact names."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from gsbake.capture.masks.matching import match_masks
from gsbake.errors import BadInputError
from gsbake.report.html import Comparison, Decision, Figure, Panel, StageRow, StageWarning, image_uri, render_page
from gsbake.text import printable
from tests.cli.conftest import End, Run
from tests.report.test_page import EMPTY, FULL, GREY, outline

#: The slash of closing markup makes a sub-folder; it is kept for photos only.
MARKUP = "[bold]photo [/red].jpg"
NAMES = {
    "window title": "\x1b]2;owned\x07 some.jpg",
    "colours": "\x1b[31mred\x1b[0m photo.jpg",
    "8-bit control": "\x9b31mred photo.jpg",
    "new line": "photo 1.jpg\ngsbake: done.jpg",
    "carriage return": "photo 1.jpg\rok         .jpg",
    "quotes": "\"photo\" 'one' `two`.jpg",
    "HTML": "<img src=x onerror=alert(1)>.jpg",
    "script": "<script>alert(1)<|script>.jpg",
    "right to left": "photo \u202egpj.exe.jpg",
    "line separator": "photo\u2028two.jpg",
    "no text": os.fsdecode(b"photo \xff\xfe\x80.jpg"),
    "255 bytes": "n" * 251 + ".jpg",
    "255 bytes in UTF-8": "é" * 125 + "x.jpg",
    "console emoji": "photo :smile:.jpg",
    "option": "--out=elsewhere.jpg",
    "shell": "$(touch owned);`id`.jpg",
    "format": "{0}%s%n{page.title}.jpg",
    "zero": "photo %00\\x00.jpg",
}
#: Several at once, for what takes longer.
ALL_IN_ONE = "\x1b]2;o\x07\n\r\u202e\x9b1m<b>\"'`[bold]:smile:{0}%s\udcff.jpg"
#: What the displays themselves print: colours and cursor movements.
OWN_SEQUENCES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def check_shown(text: str, name: str) -> None:
    """Nothing of the name is in the text as it is, and every line is printable."""
    assert all(line.isprintable() for line in text.split("\n")), [line for line in text.split("\n") if not line.isprintable()]
    assert name.isprintable() or name not in text


def check_refused(end: End, name: str) -> None:
    """One sentence and a documented exit code."""
    assert end.code in (2, 42), end
    check_shown(end.out + end.err, name)
    assert end.err.count("\n") == 1 and end.err.startswith("gsbake: "), end.err


@pytest.fixture
def hostile(capture: Path) -> list[str]:
    """A capture with photos of all these names."""
    names = [*NAMES.values(), MARKUP]
    for name in names:
        path = capture / "images" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("hostile")
    return names


@pytest.fixture(params=NAMES.values(), ids=NAMES.keys())
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_photos(run: Run, capture: Path, tmp_path: Path, hostile: list[str]) -> None:
    end = run("run", capture, "--out", "o", "-v")
    assert end.code == 0, end.err
    for name in hostile:
        check_shown(end.out + end.err, name)
        assert f"the name {printable(name)} is long" in end.err and f"name: {printable(name)} (of" in end.out
        (capture / "images" / name).write_text(f"changed {os.fsencode(name)!r}")
        states = run("explain", "ingest", "--out", "o").out
        check_shown(states, name)
        assert "photos" in states
    machine = run("explain", "ingest", "--out", "o", "--json").out
    assert machine.isascii() and "changed" in json.loads(machine)["stages"][0]["reasons"][0]
    events = (tmp_path / "o" / "events.jsonl").read_bytes()
    texts = [str(json.loads(line).get("text")) for line in events.splitlines()]
    manifest = json.loads(next((tmp_path / "o").glob("stages/ingest/*/manifest.json")).read_text())
    for name in hostile:
        assert any(printable(name) in text for text in texts) and name in manifest["inputs"]["photos"]["files"]
    assert events.isascii()


def test_on_a_terminal(run: Run, capture: Path, monkeypatch: pytest.MonkeyPatch, hostile: list[str]) -> None:
    for variable, value in {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "2000"}.items():
        monkeypatch.setenv(variable, value)
    end = run("run", capture, "--out", "o", "-v")
    assert end.code == 0 and "\x1b[" in end.out, end.err
    out, err = OWN_SEQUENCES.sub("", end.out).replace("\r", ""), OWN_SEQUENCES.sub("", end.err)
    for name in hostile:
        check_shown(out + err, name)
        assert printable(name) in out and printable(name) in err


@pytest.mark.parametrize("name", [ALL_IN_ONE, NAMES["255 bytes"]], ids=["all in one", "255 bytes"])
def test_folders(run: Run, capture: Path, tmp_path: Path, name: str) -> None:
    folder, out = tmp_path / name, tmp_path / "runs" / name
    capture.rename(folder)
    end = run("run", folder, "--out", out)
    assert end.code == 0, end.err
    check_shown(end.out + end.err, name)
    for words in (["status"], ["explain"], ["cache", "verify"], ["cache", "gc", "--dry-run"]):
        check_shown(run(*words, "--out", out).out, name)
        machine = run(*words, "--out", out, "--json")
        assert machine.out.isascii() and json.loads(machine.out)
    (tmp_path / "edited.ply").write_text("ply mine")
    machine = run("replace", "mesh", tmp_path / "edited.ply", "--out", out, "--json")
    assert name in machine.json["folder"]
    check_refused(run("run", folder / "nothing", "--out", out), name)


def test_arguments(run: Run, capture: Path, tmp_path: Path, name: str) -> None:
    profile, mine = tmp_path / "profiles" / name, tmp_path / name
    profile.parent.mkdir()
    profile.write_text("[mesh]\nfacets = 5")
    mine.write_text("no mesh")
    for words in (
        ["run", capture, "--profile", profile], ["profiles", profile], ["profiles", "./" + name[:200]], ["run", mine],
        ["run", capture, "--set", name], ["run", capture, "--set", f"mesh.holes={name}"], ["explain", "--", name],
        ["run", capture, "--masks", mine], ["run", capture, "--poses", mine], ["run", capture, f"--device={name}"],
        ["replace", "mesh", f"./{mine.name}"], ["--", name], [f"--{name}"], ["cache", "gc", f"--keep={name}"],
    ):  # fmt: skip
        check_refused(run(*words), name)
    profile.write_text("[mesh]\nfaces = 500")
    end = run("profiles", profile)
    assert end.code == 0, end.err
    check_shown(end.out, name)
    assert run("profiles", profile, "--json").json["mesh.faces"]["origin"] == str(profile)


def test_masks_without_photos(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("a mask")
    with pytest.raises(BadInputError, match="no photo belongs to") as caught:
        match_masks(tmp_path, {})
    check_shown(str(caught.value), name)
    assert printable(name) in str(caught.value)


def test_report(name: str) -> None:
    uri = image_uri(GREY)
    harmless, hostile = (
        replace(
            FULL, title=text, lead=text, figures=(Figure(text, text, text),), warnings=(StageWarning(text, text),),
            comparisons=(Comparison(text, uri, uri, 1.0, 1.0, True),), relit=(Panel(text, text, uri),), comparison_note=text,
            decisions=(Decision(text, text, text, text),), stages=(StageRow(text, text, ((text, ((text, text),)),)),), footer=text,
        )
        for text in ("harmless", name)
    )  # fmt: skip
    page = render_page(hostile)
    page.encode()
    found, plain = outline(page), outline(render_page(harmless))
    assert [tag for tag, _ in found.tags] == [tag for tag, _ in plain.tags]
    assert [sorted(attributes) for _, attributes in found.tags] == [sorted(attributes) for _, attributes in plain.tags]
    for text in [*found.text, *(value or "" for _, attributes in found.tags for value in attributes.values())]:
        check_shown(text, name)
    assert any(printable(name) in text for text in found.text)
    assert outline(render_page(replace(EMPTY, title=name))).open == []
