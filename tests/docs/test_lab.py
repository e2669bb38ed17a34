"""The lab and the decisions: tables are what `make lab` writes, narrow, dated; both are short, and no page names a commit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.lab.__main__ import main
from benchmarks.lab.pages import PAGES, RESULTS, TABLES, PageError, filled
from benchmarks.lab.tables import MAX_COLUMNS, Table, change, newest, number, signed

ROOT = Path(__file__).resolve().parents[2]
LAB, DECISIONS = (sorted((ROOT / "docs" / name).glob("*.md")) for name in ("lab", "decisions"))
FILLED = [*LAB, ROOT / "README.md"]
#: Most words, as `wc -w` counts them, of all pages of the lab and the decisions, and of one decision.
MAX_WORDS, MAX_DECISION = 12_000, 250


def words(page: Path) -> int:
    return len(page.read_text(encoding="utf-8").split())


@pytest.mark.parametrize("page", FILLED, ids=lambda page: page.name)
def test_pages_are_what_the_command_writes(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert filled(text, page.name) == text, "run `make lab`"


def test_every_table_is_on_a_page_once() -> None:
    used = re.findall(r"<!-- table: (.*?) -->", "".join(page.read_text(encoding="utf-8") for page in FILLED))
    assert sorted(used) == sorted(TABLES)


@pytest.mark.parametrize("page", [*FILLED, *DECISIONS], ids=lambda page: page.name)
def test_tables_are_narrow_and_nothing_names_a_commit(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for line in text.splitlines():
        if line.startswith("|"):
            assert len(re.sub(r"`[^`]*`", "", line).strip("|").split("|")) <= MAX_COLUMNS, line
    hashes = [word for word in re.findall(r"\b[0-9a-f]{7,}\b", text) if re.search(r"[a-f]", word) and re.search(r"\d", word)]
    assert not hashes


def test_both_are_short() -> None:
    assert sum(words(page) for page in [*LAB, *DECISIONS]) < MAX_WORDS
    assert not {page.name: words(page) for page in DECISIONS if words(page) > MAX_DECISION and page.name != "index.md"}


def test_figures_of_the_lab_stand_in_generated_tables() -> None:
    """Tables of the index alone are hand-written, and hold no measurement."""
    for page in LAB:
        rest = re.sub(r"<!-- table: .*?<!-- end -->", "", page.read_text(encoding="utf-8"), flags=re.S)
        assert page.name == "index.md" or not re.search(r"(?m)^\|", rest), page


def test_charts_are_those_that_commands_make() -> None:
    charts = {path.name for path in PAGES.rglob("*") if path.suffix not in (".md", "")}
    assert charts == {"growth.svg", "error-time-avocado.svg", "error-time-boombox.svg"}


def test_the_newest_row_of_a_kind_is_taken() -> None:
    rows = [{"a": "x", "date": day, "v": str(k)} for k, day in enumerate(("2026-11-22", "2026-11-24", "2026-11-23", "2026-11-24"))]
    assert [row["v"] for row in newest([*rows, {"a": "y", "date": "2026-11-01", "v": "y"}], "a")] == ["3", "y"]


def test_a_table_says_when_and_how() -> None:
    dates = [{"date": "2026-11-24"}, {"date": "2026-11-22"}]
    table = Table("make it", ("a", "b"), [["1", "2"]], dates)
    assert table.markdown().splitlines() == ["Measured 2026-11-22 to 2026-11-24: `make it`", "", "| a | b |", "|---|---|", "| 1 | 2 |"]
    assert Table("x", ("a",), [["1"]], dates[:1]).markdown().startswith("Measured 2026-11-24: `x`")
    for wrong in (Table("x", ["a"] * 9, [["1"] * 9], dates), Table("x", ("a", "b"), [["1"]], dates), Table("x", ("a",), [], dates)):
        with pytest.raises(ValueError):
            wrong.markdown()


def test_figures_as_text() -> None:
    assert number("", 2) == "–" and number("0.126", 1, 100) == "12.6"
    assert signed(-0.26, 1) == "−0.3" and signed(0.04, 1) == "0" == signed(-0.04, 1)
    assert change("1.04", "1.01", 1) == "1.0" and change("1", "2", 0) == "1 → 2"


def test_prose_stays_and_markers_must_pair(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- table: batch -->\nold\n<!-- end -->\nafter\n", encoding="utf-8")
    assert main(["--pages", str(tmp_path)]) == 0 and capsys.readouterr().out == f"{page}\n"
    made = page.read_text(encoding="utf-8")
    assert made.startswith("before\n<!-- table: batch -->\n\nMeasured 20") and made.endswith("|\n\n<!-- end -->\nafter\n")
    assert main(["--pages", str(tmp_path)]) == 0 and capsys.readouterr().out == ""
    with pytest.raises(PageError, match="do not pair"):
        filled("<!-- table: batch -->\n", "page.md")
    with pytest.raises(PageError, match="'nothing'"):
        filled("<!-- table: nothing -->\n<!-- end -->\n", "page.md")
    assert main(["--pages", str(tmp_path), "--results", str(tmp_path)]) == 1
    assert "batch.csv" in capsys.readouterr().err


def test_every_file_of_results_has_dates() -> None:
    for path in RESULTS.glob("*.csv"):
        first, *lines = path.read_text(encoding="utf-8").splitlines()
        assert "date" in first.split(",") and all(re.search(r",20\d\d-\d\d-\d\d$", line) for line in lines), path
