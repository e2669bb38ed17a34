"""Charts: drawn figures, legend and Pareto front."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.charts import COLOURS, Panel, Series, figure, pareto, write

NUMBER = st.floats(1e-3, 1e4)
OURS = Series("ours & <theirs>", [(10, 1.0), (100, 0.1)], 0)
QUOTED = Series("peer (quoted)", [(50, 0.5), (200, 0.5)], 1, "markers", True)
PANELS = [
    Panel("Error", "seconds", "%", [OURS, QUOTED], front=True),
    Panel("PSNR", "seconds", "dB", [OURS, Series("none", [], 2)], log_y=False),
    Panel("Empty", "x", "y", []),
]


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=30))
def test_no_point_beats_the_front_and_the_front_beats_the_others(points: list[tuple[float, float]]) -> None:
    front = pareto(points)
    assert front == sorted(front, key=lambda i: points[i][0])

    def beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    for i, point in enumerate(points):
        beaten = any(beats(other, point) for other in points)
        duplicate = any(points[j] == point for j in front)
        assert (i in front) or beaten or duplicate
        assert not (i in front and beaten)


def test_a_figure_has_its_points_scales_and_front() -> None:
    error, psnr = figure("Title", PANELS).axes
    assert (error.get_title(), error.get_xscale(), error.get_yscale()) == ("Error", "log", "log")
    assert (psnr.get_title(), psnr.get_xscale(), psnr.get_yscale(), psnr.get_ylabel()) == ("PSNR", "log", "linear", "dB")
    front, ours, quoted = error.get_lines()
    assert [tuple(p) for p in front.get_xydata()] == [(10, 1.0), (50, 0.5), (100, 0.1)] and front.get_drawstyle() == "steps-post"
    assert [tuple(p) for p in ours.get_xydata()] == OURS.points and (ours.get_linestyle(), ours.get_color()) == ("-", COLOURS[0])
    assert (quoted.get_linestyle(), quoted.get_markerfacecolor(), quoted.get_color()) == ("None", "none", COLOURS[1])
    assert len(psnr.get_lines()) == 1


def test_axes_show_round_numbers_without_exponents() -> None:
    made = figure("Title", [Panel("", "", "", [Series("a", [(8_000, 0.03), (120_000, 7.0)], 0)])])
    made.draw_without_rendering()
    x, y = ([label.get_text() for label in axis.get_ticklabels()] for axis in (made.axes[0].xaxis, made.axes[0].yaxis))
    assert {"10 000", "20 000", "50 000", "100 000"} <= set(x) and {"0.05", "0.1", "5"} <= set(y)


def test_the_file_has_each_label_once_and_the_same_bytes_again(tmp_path: Path) -> None:
    for name in ("a.svg", "b.svg"):
        write(tmp_path / "new" / name, "Title", PANELS)
    assert (tmp_path / "new" / "a.svg").read_bytes() == (tmp_path / "new" / "b.svg").read_bytes()
    texts = [t.text for t in ElementTree.parse(tmp_path / "new" / "a.svg").iter("{http://www.w3.org/2000/svg}text")]
    for label in ("Title", "ours & <theirs>", "peer (quoted)", "Pareto front"):
        assert texts.count(label) == 1
    assert "Empty" not in texts and "none" not in texts


def test_a_figure_without_points_is_an_error() -> None:
    with pytest.raises(ValueError, match="nothing to draw"):
        figure("Title", [Panel("Empty", "x", "y", [])])
