"""The index page: its script sorts figures as numbers, empty ones last, and names as text."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest

from gsbake.batch.page import COLUMNS, Cell, Row, render, write_index

#: A document of the page's rows that knows what the script asks for; prints the order of the names after each selection.
_DOCUMENT = """
const [script, table] = [process.argv[1], JSON.parse(process.argv[2])];
const cell = (sort) => ({ dataset: { sort } });
const body = { rows: table.map((cells) => ({ cells: cells.map(cell) })), append(...rows) { this.rows = rows; } };
const buttons = table[0].slice(0, -1).map((_, cellIndex) => ({
  dataset: {}, parentElement: { cellIndex }, addEventListener(_, select) { this.select = select; },
}));
globalThis.document = { querySelector: () => body, querySelectorAll: () => buttons };
(0, eval)(script);
const names = () => body.rows.map((row) => row.cells[1].dataset.sort);
console.log(JSON.stringify(JSON.parse(process.argv[3]).map((column) => { buttons[column].select(); return names(); })));
"""


def row(name: str, photos: float | None, state: str = "done") -> Row:
    cells = (Cell() if photos is None else Cell(str(photos), photos), *(Cell() for _ in COLUMNS[1:]))
    return Row(name, state, "", "", "", "", cells)


def test_sorting() -> None:
    node = shutil.which("node", path=str(Path(sys.executable).parent)) or shutil.which("node")
    if node is None:
        pytest.skip("needs Node")
    page = render([row("mug 10", 9), row("mug 9", 100), row("7", None, "failed"), row("axe", 25)])
    rows = re.findall(r"<tr>\n<td>.*?</tr>", page, re.DOTALL)
    table = [["", *re.findall(r'data-sort="([^"]*)"', text), ""] for text in rows]
    assert len(table) == 4 and len(table[0]) == 4 + len(COLUMNS)
    script = resources.files("gsbake.batch").joinpath("index.js").read_text()
    done = subprocess.run(
        [node, "-e", _DOCUMENT, script, json.dumps(table), json.dumps([3, 3, 1, 1])], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == [
        ["mug 9", "axe", "mug 10", "7"], ["7", "mug 10", "axe", "mug 9"], ["7", "axe", "mug 9", "mug 10"], ["mug 10", "mug 9", "axe", "7"],
    ]  # fmt: skip


def test_the_page_needs_no_network_and_escapes_names() -> None:
    page = render([row("<b>&", 3), row("two", 4, "running")])
    assert "&lt;b&gt;&amp;" in page and "<b>" not in page and "1 done, 1 running, 0 failed" in page
    assert not re.search(r"(src|href)=\"(?!data:)[a-z]+:", page)


def test_an_index_that_gsbake_did_not_write_stays(tmp_path: Path) -> None:
    index = write_index([], tmp_path)
    assert index == tmp_path / "index.html" and write_index([], tmp_path) == index
    page = index.read_text()
    for theirs in ("<h1>my page</h1>", page.replace("<body>", "<body>note to self")):
        index.write_text(theirs)
        assert write_index([], tmp_path) == write_index([], tmp_path) == tmp_path / "index.new.html"
        assert index.read_text() == theirs and (tmp_path / "index.new.html").read_text() == page
    index.unlink()
    index.symlink_to(tmp_path / "elsewhere.html")
    assert write_index([], tmp_path) == tmp_path / "index.new.html" and not (tmp_path / "elsewhere.html").exists()
