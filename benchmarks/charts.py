"""Line charts as SVG without a plotting library: panels on logarithmic or linear axes, one legend, light and dark backgrounds.

The file carries its own style sheet and paper; a viewer that prefers dark gets dark paper and light ink. Numbers keep two digits after the
point: charts made of the same figures are the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Literal

Point = tuple[float, float]

#: Hues that stay apart for colour-blind eyes (Okabe and Ito 2008), moved to a middle lightness that reads on white and on black.
COLOURS = ("#0b7fc4", "#d95f02", "#009e73", "#cc5fa0", "#b58900", "#7a6ff0", "#8a8a8a")
STYLE = """
text { font: 12px system-ui, sans-serif; fill: #24292f }
.title { font-weight: 600; font-size: 13px } .tick { font-size: 11px; fill: #57606a }
.paper { fill: #fff } .grid { stroke: #d0d7de; stroke-width: .7 } .frame { fill: none; stroke: #8c959f } .hollow { fill: #fff }
.front { fill: none; stroke: #8c959f; stroke-opacity: .35; stroke-width: 9; stroke-linejoin: round } .line { fill: none; stroke-width: 1.8 }
@media (prefers-color-scheme: dark) {
text { fill: #e6edf3 } .tick { fill: #9da7b1 } .paper, .hollow { fill: #0d1117 } .grid { stroke: #30363d } }
"""
PANEL_WIDTH, PANEL_HEIGHT, LEFT, TOP, RIGHT, BOTTOM = 380, 260, 62, 34, 18, 48
LEGEND_ROW, LEGEND_WIDTH = 20, 290
#: Room between the figures and the frame, as a share of the axis.
PAD = 0.05


@dataclass(frozen=True)
class Series:
    """Points with a label; `hollow` marks what was not measured here, `style` draws a line, a dashed line, or markers alone."""

    label: str
    points: Sequence[Point]
    colour: int
    style: Literal["line", "dash", "markers"] = "line"
    hollow: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes; `front` draws the Pareto front (lower is better on both axes) of all its points behind them."""

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


def staircase(front: Sequence[Point]) -> list[Point]:
    """The border of what a Pareto front (by rising x) beats: level until the next point, then down to it."""
    out = list(front[:1])
    for before, point in pairwise(front):
        out += [(point[0], before[1]), point]
    return out


@dataclass(frozen=True)
class Axis:
    """Values to 0..1."""

    low: float
    high: float
    log: bool

    @staticmethod
    def around(values: Sequence[float], log: bool) -> Axis:
        """An axis with some room around `values`; equal ones get an axis all the same."""
        ends = [math.log10(v) if log else v for v in (min(values), max(values))]
        room = PAD * (ends[1] - ends[0]) or 0.1
        return Axis(ends[0] - room, ends[1] + room, log)

    def place(self, value: float) -> float:
        """Where a value lies, 0..1."""
        return ((math.log10(value) if self.log else value) - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        """Round values inside the axis: 1, 2, 5 times powers of ten when logarithmic (one a decade when there are many), else some five."""
        if self.log:
            steps = (1, 2, 5) if self.high - self.low < 2.5 else (1,)
            values = [s * 10.0**e for e in range(math.floor(self.low), math.ceil(self.high) + 1) for s in steps]
            return [v for v in values if self.low <= math.log10(v) <= self.high]
        raw = (self.high - self.low) / 5
        unit = 10.0 ** math.floor(math.log10(raw))
        step = unit * next(s for s in (1, 2, 5, 10) if s * unit >= raw)
        return [k * step for k in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]


def label(value: float) -> str:
    """A tick's text: short, 20 000 as 20 k."""
    return f"{value / 1000:g} k" if abs(value) >= 10_000 else f"{value:.4g}"


def panel_svg(panel: Panel, left: float, top: float) -> list[str]:
    """The lines of one panel whose outer corner is at (left, top)."""
    points = [p for s in panel.series for p in s.points]
    x, y = Axis.around([p[0] for p in points], panel.log_x), Axis.around([p[1] for p in points], panel.log_y)
    x0, y0, width, height = left + LEFT, top + TOP, PANEL_WIDTH - LEFT - RIGHT, PANEL_HEIGHT - TOP - BOTTOM

    def across(value: float) -> float:
        return x0 + width * x.place(value)

    def down(value: float) -> float:
        return y0 + height * (1 - y.place(value))

    def path(points: Sequence[Point]) -> str:
        return " ".join(f"{across(px):.2f},{down(py):.2f}" for px, py in points)

    out = [f'<text class="title" x="{x0}" y="{top + 20}">{escape(panel.title)}</text>']
    for value in x.ticks():
        px = across(value)
        out.append(f'<line class="grid" x1="{px:.2f}" y1="{y0}" x2="{px:.2f}" y2="{y0 + height}"/>')
        out.append(f'<text class="tick" x="{px:.2f}" y="{y0 + height + 16}" text-anchor="middle">{label(value)}</text>')
    for value in y.ticks():
        py = down(value)
        out.append(f'<line class="grid" x1="{x0}" y1="{py:.2f}" x2="{x0 + width}" y2="{py:.2f}"/>')
        out.append(f'<text class="tick" x="{x0 - 6}" y="{py + 4:.2f}" text-anchor="end">{label(value)}</text>')
    out.append(f'<rect class="frame" x="{x0}" y="{y0}" width="{width}" height="{height}"/>')
    out.append(f'<text x="{x0 + width / 2:.2f}" y="{y0 + height + 36}" text-anchor="middle">{escape(panel.x_label)}</text>')
    middle = y0 + height / 2
    turned = f'transform="rotate(-90 {left + 14} {middle:.2f})" text-anchor="middle"'
    out.append(f'<text x="{left + 14}" y="{middle:.2f}" {turned}>{escape(panel.y_label)}</text>')
    if panel.front:
        out.append(f'<polyline class="front" points="{path(staircase([points[i] for i in pareto(points)]))}"/>')
    for series in panel.series:
        colour = COLOURS[series.colour % len(COLOURS)]
        if series.style != "markers":
            dash = ' stroke-dasharray="6 4"' if series.style == "dash" else ""
            out.append(f'<polyline class="line" stroke="{colour}"{dash} points="{path(series.points)}"/>')
        out += [marker(across(px), down(py), series) for px, py in series.points]
    return out


def marker(x: float, y: float, series: Series) -> str:
    """A dot, or a larger ring for what was not measured here."""
    colour = COLOURS[series.colour % len(COLOURS)]
    if series.hollow:
        return f'<circle class="hollow" cx="{x:.2f}" cy="{y:.2f}" r="5" stroke="{colour}" stroke-width="2"/>'
    return f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{5 if series.style == "markers" else 3}" fill="{colour}"/>'


def legend_svg(panels: Sequence[Panel], top: float, columns: int) -> tuple[list[str], int]:
    """The legend's lines, each label once, and its number of rows."""
    entries = list({s.label: s for p in panels for s in p.series}.values())
    front = any(p.front for p in panels)
    out = []
    for i, series in enumerate([*entries, None] if front else entries):
        x, y = 20 + LEGEND_WIDTH * (i % columns), top + LEGEND_ROW * (i // columns)
        if series is None:
            out.append(f'<line class="front" x1="{x}" y1="{y}" x2="{x + 26}" y2="{y}"/>')
        else:
            if series.style != "markers":
                dash = ' stroke-dasharray="6 4"' if series.style == "dash" else ""
                colour = COLOURS[series.colour % len(COLOURS)]
                out.append(f'<line class="line" stroke="{colour}"{dash} x1="{x}" y1="{y}" x2="{x + 26}" y2="{y}"/>')
            out.append(marker(x + 13, y, series))
        out.append(f'<text x="{x + 34}" y="{y + 4}">{escape(series.label if series else "nothing is both quicker and nearer")}</text>')
    return out, math.ceil((len(entries) + front) / columns)


def figure(title: str, panels: Sequence[Panel], columns: int = 2) -> str:
    """The SVG document of panels in `columns`, with one legend below; panels without points are left out.

    Raises ValueError when none has points, or when a logarithmic axis is given a value that is not positive.
    """
    shown = [p for p in panels if any(s.points for s in p.series)]
    if not shown:
        raise ValueError("there is nothing to draw")
    columns = min(columns, len(shown))
    rows = math.ceil(len(shown) / columns)
    width, below = PANEL_WIDTH * columns, 40 + PANEL_HEIGHT * rows
    body = [f'<text class="title" x="20" y="26" style="font-size:15px">{escape(title)}</text>']
    for i, panel in enumerate(shown):
        body += panel_svg(panel, PANEL_WIDTH * (i % columns), 32 + PANEL_HEIGHT * (i // columns))
    legend, lines = legend_svg(shown, below + 14, max(1, (width - 20) // LEGEND_WIDTH))
    height = below + LEGEND_ROW * lines + 14
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img">'
    paper = f'<rect class="paper" width="{width}" height="{height}"/>'
    return "\n".join([head, f"<title>{escape(title)}</title><style>{STYLE}</style>", paper, *body, *legend, "</svg>"]) + "\n"


def write(path: Path, title: str, panels: Sequence[Panel], columns: int = 2) -> None:
    """Write `figure` to a file, whose folder is made if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(figure(title, panels, columns))
