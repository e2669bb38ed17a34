"""Line charts of benchmark results as SVG: panels on logarithmic or linear axes with one legend.

Drawn by matplotlib (extra `bench`). Charts of the same figures are the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gsbake.text import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Point = tuple[float, float]

#: Palette for colour-blind readers (Okabe and Ito 2008), with medium lightness.
COLOURS = ("#0b7fc4", "#d95f02", "#009e73", "#cc5fa0", "#b58900", "#7a6ff0", "#8a8a8a")
#: matplotlib settings: text stays text, identifiers do not change between runs.
STYLE = {"svg.fonttype": "none", "svg.hashsalt": "gsbake", "font.size": 9, "font.family": "sans-serif"}
LINE_STYLES = {"line": "-", "dash": "--", "markers": "none"}
#: Size of one panel and height of a row of the legend in inches.
PANEL_SIZE, LEGEND_HEIGHT = (4.0, 2.9), 0.22


@dataclass(frozen=True)
class Series:
    """Points with a label; `hollow` marks quoted figures, `style` is a line, a dashed line, or markers alone."""

    label: str
    points: Sequence[Point]
    colour: int
    style: Literal["line", "dash", "markers"] = "line"
    hollow: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes; `front` adds the Pareto front (lower is better on both axes) of all its points."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    log_x: bool = True
    log_y: bool = True
    front: bool = False


def pareto(points: Sequence[Point]) -> list[int]:
    """Indices of the points that no other beats on both axes (lower is better), by rising x; of equal points the first."""
    kept: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if not kept or points[i][1] < points[kept[-1]][1]:
            kept.append(i)
    return kept


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw a panel's series, Pareto front, scales and labels into `axes`."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    series = [s for s in panel.series if s.points]
    if panel.front:
        points = [p for s in series for p in s.points]
        x, y = zip(*(points[i] for i in pareto(points)), strict=True)
        axes.step(x, y, where="post", color="#8c959f", alpha=0.35, linewidth=6, label="Pareto front")
    for s in series:
        x, y = zip(*s.points, strict=True)
        colour = COLOURS[s.colour % len(COLOURS)]
        size, face = 6 if s.style == "markers" else 3, "none" if s.hollow else colour
        axes.plot(x, y, color=colour, linestyle=LINE_STYLES[s.style], marker="o", markersize=size, markerfacecolor=face, label=s.label)
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    axes.grid(alpha=0.4, linewidth=0.6)
    for log, axis in ((panel.log_x, "x"), (panel.log_y, "y")):
        if log:
            axes.set(**{f"{axis}scale": "log"})
            ticks = getattr(axes, f"{axis}axis")
            ticks.set_major_locator(LogLocator(subs=(1, 2, 5)))
            ticks.set_minor_locator(NullLocator())
            ticks.set_major_formatter(FuncFormatter(lambda value, _: number(value)))


def figure(title: str, panels: Sequence[Panel], columns: int = 2) -> Figure:
    """Panels in `columns` with one legend below; panels without points are skipped. Raises ValueError when none has points."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    shown = [p for p in panels if any(s.points for s in p.series)]
    if not shown:
        raise ValueError("there is nothing to draw")
    columns = min(columns, len(shown))
    rows = math.ceil(len(shown) / columns)
    with rc_context(STYLE):
        made = Figure(layout="constrained")
        every = made.subplots(rows, columns, squeeze=False).ravel()
        for axes, panel in zip(every, shown, strict=False):
            draw_panel(axes, panel)
        for axes in every[len(shown) :]:
            axes.remove()
        entries = {line.get_label(): line for axes in made.axes for line in axes.get_lines()}
        legend_height = LEGEND_HEIGHT * math.ceil(len(entries) / columns)
        made.set_size_inches(PANEL_SIZE[0] * columns, PANEL_SIZE[1] * rows + 0.3 + legend_height)
        made.suptitle(title, fontweight="bold")
        made.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)
    return made


def write(path: Path, title: str, panels: Sequence[Panel], columns: int = 2) -> None:
    """Write `figure` as SVG to `path`; its folder is created if missing."""
    from matplotlib import rc_context

    path.parent.mkdir(parents=True, exist_ok=True)
    made = figure(title, panels, columns)
    with rc_context(STYLE):
        made.savefig(path, format="svg", metadata={"Date": None})
