"""Charts: what is drawn where, and what is on the Pareto front."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.charts import Axis, Panel, Series, figure, label, pareto, write

SVG = "{http://www.w3.org/2000/svg}"
NUMBER = st.floats(1e-3, 1e4)


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=30))
def test_nothing_beats_the_front_and_the_front_beats_the_rest(points: list[tuple[float, float]]) -> None:
    front = pareto(points)
    assert front == sorted(front, key=lambda i: points[i][0])

    def beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    for i, point in enumerate(points):
        beaten = any(beats(other, point) for other in points)
        twin = any(points[j] == point for j in front)
        assert (i in front) or beaten or twin
        assert not (i in front and beaten)


@pytest.mark.parametrize(
    ("log", "values", "expected"), [(True, (8, 120), [10, 20, 50, 100]), (False, (0.91, 0.99), [0.92, 0.94, 0.96, 0.98])]
)
def test_ticks_are_round_and_inside(log: bool, values: tuple[float, float], expected: list[float]) -> None:
    assert Axis.around(values, log).ticks() == pytest.approx(expected)


def test_axes_place_their_ends_inside_and_in_order() -> None:
    for log in (True, False):
        axis = Axis.around([3.0, 700.0], log)
        assert 0 < axis.place(3.0) < axis.place(50.0) < axis.place(700.0) < 1
    assert Axis.around([5.0, 5.0], False).place(5.0) == pytest.approx(0.5)


def test_tick_texts() -> None:
    assert [label(v) for v in (0.05, 100.0, 20_000.0)] == ["0.05", "100", "20 k"]


def test_a_figure_has_its_points_lines_and_one_legend_entry_a_label(tmp_path: Path) -> None:
    ours = Series("ours & <theirs>", [(10, 1.0), (100, 0.1)], 0)
    quoted = Series("peer (quoted)", [(50, 0.5)], 1, "markers", True)
    panels = [Panel("Error", "seconds", "%", [ours, quoted], front=True), Panel("PSNR", "seconds", "dB", [ours], log_y=False)]
    write(tmp_path / "new" / "chart.svg", "Title", [*panels, Panel("Empty", "x", "y", [])])
    root = ElementTree.parse(tmp_path / "new" / "chart.svg").getroot()
    texts = [t.text for t in root.iter(f"{SVG}text")]
    assert texts.count("ours & <theirs>") == 1 and texts.count("peer (quoted)") == 1 and "Empty" not in texts
    lines = [p for p in root.iter(f"{SVG}polyline") if p.get("class") == "line"]
    assert len(lines) == 2
    assert len([c for c in root.iter(f"{SVG}circle") if c.get("class") == "hollow"]) == 2  # in the panel and in the legend
    front = next(p for p in root.iter(f"{SVG}polyline") if p.get("class") == "front")
    assert len(re.findall(r"\S+,\S+", str(front.get("points")))) == 5  # three points, two corners
    (x1, y1), (x2, y2) = (tuple(map(float, p.split(","))) for p in str(lines[0].get("points")).split())
    assert x1 < x2 and y1 < y2  # later and nearer: to the right and down
    assert "prefers-color-scheme: dark" in figure("Title", panels)


def test_an_empty_figure_is_an_error() -> None:
    with pytest.raises(ValueError, match="nothing to draw"):
        figure("Title", [Panel("Empty", "x", "y", [])])
