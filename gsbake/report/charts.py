"""Inline SVG charts of the report: bars of stage times and memory, and training curves. Colours are CSS variables of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from gsbake.text import duration

#: Maximum points per curve; about one per two pixels.
MAX_CURVE_POINTS = 240


@dataclass(frozen=True)
class Bar:
    """One row of a bar chart: name, value, label, and segments as (name, value)."""

    name: str
    value: float
    text: str
    parts: tuple[tuple[str, float], ...] = ()


def bars(rows: Sequence[Bar], label: str) -> str:
    """Horizontal bars on a common scale; segments alternate in colour and are named in tooltips."""
    line, left, width = 30, 92, 640
    room = width - left - 96
    longest = max((row.value for row in rows), default=0) or 1.0
    out = [f'<svg class="chart bars" viewBox="0 0 {width} {line * max(len(rows), 1)}" role="img" aria-label="{escape(label)}">']
    for i, row in enumerate(rows):
        y = i * line
        size = room * row.value / longest
        out.append(f'<text class="name" x="{left - 10}" y="{y + 19}" text-anchor="end">{escape(row.name)}</text>')
        shape = f'x="{left}" y="{y + 7}" width="{max(size, 1.5):.1f}" height="16" rx="3"'
        out.append(f'<rect class="bar" {shape}><title>{escape(row.text)}</title></rect>')
        at = float(left)
        for k, (name, value) in enumerate(row.parts):
            piece = size * value / row.value if row.value > 0 else 0.0
            piece = max(0.0, min(piece, left + size - at))
            if piece >= 1:
                title = f"{escape(name)}: {duration(value)}"
                shade = f'class="part p{k % 2}" x="{at:.1f}" y="{y + 7}" width="{piece:.1f}" height="16"'
                out.append(f"<rect {shade}><title>{title}</title></rect>")
            at += piece
        out.append(f'<text class="value" x="{left + size + 8:.1f}" y="{y + 19}">{escape(row.text)}</text>')
    return "".join(out) + "</svg>"


@dataclass(frozen=True)
class Curve:
    """One named line: x and y of equal length; points that are not finite are skipped."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


def ticks(low: float, high: float, count: int = 4) -> list[float]:
    """About `count` multiples of 1, 2 or 5 times a power of ten within low..high."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low]
    rough = (high - low) / count
    power = 10 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """1, 2 and 5 times powers of ten within low..high (both above 0); fewer factors where these are more than `most`."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1, 2, 5), (1, 3), (1,)):
        found = [m * 10.0**k for k in powers for m in factors if low <= m * 10.0**k <= high]
        if len(found) <= most:
            break
    return found


def _downsample(curve: Curve, log: bool) -> list[tuple[float, float]]:
    """Finite points of the curve, averaged in groups down to MAX_CURVE_POINTS."""
    points = [(x, y) for x, y in zip(curve.x, curve.y, strict=True) if math.isfinite(x) and math.isfinite(y) and (y > 0 or not log)]
    if len(points) <= MAX_CURVE_POINTS:
        return points
    edges = [round(i * len(points) / MAX_CURVE_POINTS) for i in range(MAX_CURVE_POINTS + 1)]
    groups = [points[a:b] for a, b in zip(edges, edges[1:], strict=False) if b > a]
    return [(sum(p[0] for p in g) / len(g), sum(p[1] for p in g) / len(g)) for g in groups]


def lines(curves: Sequence[Curve], title: str, log: bool = False) -> str:
    """A line chart with a legend; an empty string when no curve has two points. `log`: logarithmic y axis."""
    kept = [(curve.name, points) for curve in curves if len(points := _downsample(curve, log)) >= 2]
    if not kept:
        return ""
    width, height, left, right, top, bottom = 460, 230, 48, 12, 34, 26
    scale = math.log10 if log else float
    xs = [x for _, points in kept for x, _ in points]
    ys = [scale(y) for _, points in kept for _, y in points]
    x0, x1, y0, y1 = min(xs), max(xs), min(ys), max(ys)
    x1 = x1 if x1 > x0 else x0 + 1
    pad = 0.05 * (y1 - y0) or max(abs(y0) * 0.05, 1e-6)
    y0, y1 = y0 - pad, y1 + pad

    def px(x: float) -> float:
        return left + (width - left - right) * (x - x0) / (x1 - x0)

    def py(y: float) -> float:
        return height - bottom - (height - top - bottom) * (y - y0) / (y1 - y0)

    out = [f'<svg class="chart lines" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}">']
    out.append(f'<text class="title" x="{left}" y="15">{escape(title)}</text>')
    values = log_ticks(10**y0, 10**y1) if log else ticks(y0, y1)
    if log and len(values) < 2:  # a narrow range
        values = ticks(10**y0, 10**y1)
    for value, shown in zip(values, labels(values), strict=True):
        y = py(scale(value))
        out.append(f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        out.append(f'<text class="tick" x="{left - 6}" y="{y + 3.5:.1f}" text-anchor="end">{shown}</text>')
    steps = ticks(x0, x1)
    for x, shown in zip(steps, labels(steps), strict=True):
        out.append(f'<text class="tick" x="{px(x):.1f}" y="{height - 8}" text-anchor="middle">{shown}</text>')
    at = float(width - right)
    for k in reversed(range(len(kept))):
        name, points = kept[k]
        path = " ".join(f"{px(x):.1f},{py(scale(y)):.1f}" for x, y in points)
        out.append(f'<polyline class="c{k % 5}" points="{path}"/>')
        if len(kept) > 1:
            out.append(f'<text class="legend c{k % 5}" x="{at:.0f}" y="15" text-anchor="end">{escape(name)}</text>')
            at -= 7 * len(name) + 14
    return "".join(out) + "</svg>"


def labels(values: Sequence[float]) -> list[str]:
    """Axis labels with the fewest digits that distinguish the values."""
    for digits in range(3, 9):
        out = [number(value, digits) for value in values]
        if len(set(out)) == len(set(values)):
            break
    return out


def number(value: float, digits: int = 3) -> str:
    """Axis label of a number: 0, 0.25, 12, 3k, 1e-4, with `digits` significant digits."""
    if value == 0 or abs(value) < 1e-12:
        return "0"
    if abs(value) >= 1e6:
        return f"{value / 1e6:.{digits}g}M"
    if abs(value) >= 1000:
        return f"{value / 1000:.{digits}g}k"
    if abs(value) < 1e-3:
        return f"{value:.{digits - 3}e}".replace("e-0", "e-")
    return f"{value:.{digits}g}"
