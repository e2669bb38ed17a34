"""Table of error against time: CSV file, merging, Pareto front."""

from __future__ import annotations

from pathlib import Path

from benchmarks.peers import QUOTED
from benchmarks.rows import Row, draw, front, markdown, merged, read_csv, write_csv


def row(seconds: float, chamfer: float | None, start: str = "hull", **more: object) -> Row:
    return Row("thing", "gsbake", "preview", start, 100, seconds, chamfer, 0.5, 7.0, 20.0, 300.0, **more)  # type: ignore[arg-type]


def test_csv_round_trip(tmp_path: Path) -> None:
    rows = [row(10.0, 1.5), row(20.0, None), *QUOTED]
    write_csv(tmp_path / "deep" / "t.csv", rows)
    assert sorted(map(str, read_csv(tmp_path / "deep" / "t.csv"))) == sorted(map(str, rows))
    assert read_csv(tmp_path / "none.csv") == []


def test_new_rows_replace_their_series_only() -> None:
    old = [row(10.0, 1.5), row(11.0, 1.4), row(12.0, 1.0, "sphere"), row(9.0, 1.0, source="quoted")]
    assert merged(old, [row(5.0, 2.0)]) == [*old[2:], row(5.0, 2.0)]
    assert merged(old, []) == old


def test_the_front_has_no_beaten_rows_and_none_without_a_mesh() -> None:
    rows = [row(30.0, 0.5), row(5.0, None), row(10.0, 1.0), row(20.0, 1.2), row(40.0, 0.5)]
    assert [r.seconds for r in front(rows)] == [10.0, 30.0]
    table = markdown(rows + [row(15.0, 0.7, source="quoted")])
    assert [line.split("|")[4].strip() for line in table.splitlines()[2:]] == ["10", "15", "30"]
    assert "preview, from hull (quoted)" in table


def test_rows_without_some_figures_have_a_chart(tmp_path: Path) -> None:
    draw(tmp_path / "c.svg", "avocado", [row(10.0, 1.0), row(20.0, None), *QUOTED])
    text = (tmp_path / "c.svg").read_text()
    assert text.count("OpenMVS 2.3 (quoted)") == 1 and "preview, from hull" in text
