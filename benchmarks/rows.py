"""Table of error against time: one row per measured or quoted mesh, its CSV file, charts, and Pareto front as Markdown.

Seconds are wall time from the photos to the mesh, ingest and structure from motion included.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Literal

from benchmarks.charts import Panel, Point, Series, pareto, write
from benchmarks.csv_rows import today
from benchmarks.truth import Figures

#: {initialisation: colour index}, and colour indices of other tools.
INIT_COLOURS = {"stereo": 0, "hull": 1, "points": 2, "sphere": 3}
PEER_COLOURS = (4, 5, 6)


@dataclass(frozen=True)
class Row:
    """One mesh: tool, settings, time, and error against the ground truth; None where there is no such figure.

    `start` is the initialisation of the surfels. `chamfer_pct` (% of the true diagonal), `fscore` (at 1 % of it, 0..1) and `normal_deg` are
    None without a mesh. `psnr` (dB) is that of the surfels on held-out photos at the profile's training size: comparable within one profile
    only.
    """

    capture: str
    tool: str
    profile: str
    start: str
    steps: int | None
    seconds: float
    chamfer_pct: float | None = None
    fscore: float | None = None
    normal_deg: float | None = None
    psnr: float | None = None
    peak_mb: float | None = None
    source: Literal["measured", "quoted"] = "measured"
    date: str = field(default_factory=today)

    def with_figures(self, figures: Figures) -> Row:
        """The row with a mesh's figures."""
        return Row(**asdict(self) | {k: getattr(figures, k) for k in ("chamfer_pct", "fscore", "normal_deg")})

    @property
    def series(self) -> tuple[str, str, str, str, str]:
        """Key of rows that are measured together and replace each other in the CSV."""
        return self.capture, self.source, self.tool, self.profile, self.start

    @property
    def family(self) -> str:
        """The tool without its version."""
        return self.tool.split()[0]

    @property
    def name(self) -> str:
        """The row's label in charts and tables."""
        label = f"{self.profile}, from {self.start}" if self.profile else self.tool
        return f"{label} (quoted)" if self.source == "quoted" else label


def read_csv(path: Path) -> list[Row]:
    """The rows of a CSV file written by `write_csv`; none when it does not exist."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [_row(line) for line in csv.DictReader(file)]


def _row(line: dict[str, str]) -> Row:
    numbers = {k: float(line[k]) if line[k] else None for k in ("seconds", "chamfer_pct", "fscore", "normal_deg", "psnr", "peak_mb")}
    return Row(**line | numbers | {"steps": int(line["steps"]) if line["steps"] else None})  # type: ignore[arg-type]


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Write rows, by series and time, figures to four digits after the point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Row)], lineterminator="\n")
        writer.writeheader()
        for row in sorted(rows, key=lambda r: (*r.series, r.seconds)):
            writer.writerow({k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(row).items()})


def merged(old: Iterable[Row], new: Sequence[Row]) -> list[Row]:
    """The new rows, and the old ones of series that were not measured again."""
    again = {row.series for row in new}
    return [row for row in old if row.series not in again] + list(new)


def front(rows: Iterable[Row]) -> list[Row]:
    """Pareto front of one capture in seconds and Chamfer distance, by rising seconds."""
    points: list[Point] = []
    meshed = []
    for row in rows:
        if row.chamfer_pct is not None:
            meshed.append(row)
            points.append((row.seconds, row.chamfer_pct))
    return [meshed[i] for i in pareto(points)]


def markdown(rows: Sequence[Row]) -> str:
    """The Pareto fronts of all captures as one Markdown table."""
    lines = ["| capture | made by | steps | seconds | Chamfer % | F@1 % | normal ° |", "|---|---|---|---|---|---|---|"]
    for capture in sorted({row.capture for row in rows}):
        for row in front(r for r in rows if r.capture == capture):
            cells = [text(row.steps, "d"), text(row.seconds, ".0f"), text(row.chamfer_pct, ".3f"), text(row.fscore, ".3f")]
            lines.append("| " + " | ".join([capture, row.name, *cells, text(row.normal_deg, ".1f")]) + " |")
    return "\n".join(lines) + "\n"


def text(value: float | None, form: str) -> str:
    """A figure, or a dash where there is none."""
    return "–" if value is None else format(value, form)


def _series(rows: Sequence[Row], figure: str) -> list[Series]:
    profiles = sorted({row.profile for row in rows if row.profile})
    peers = sorted({row.family for row in rows if not row.profile})
    out = []
    for key in sorted({row.series for row in rows}):
        chosen = sorted((r for r in rows if r.series == key), key=lambda r: r.seconds)
        first = chosen[0]
        points = [(r.seconds, value) for r in chosen if (value := getattr(r, figure)) is not None]
        if first.profile:
            style: Literal["line", "dash"] = "dash" if profiles.index(first.profile) % 2 else "line"
            out.append(Series(first.name, points, INIT_COLOURS.get(first.start, 6), style))
        else:
            colour = PEER_COLOURS[peers.index(first.family) % len(PEER_COLOURS)]
            out.append(Series(first.name, points, colour, "markers", first.source == "quoted"))
    return [s for s in out if s.points]


def draw(path: Path, capture: str, rows: Sequence[Row]) -> None:
    """Four panels over seconds for one capture: Chamfer distance with its Pareto front, normal error, F-score, PSNR."""
    spent = "seconds from the photos to the mesh"
    panels = [
        Panel("Chamfer distance", spent, "% of the diagonal", _series(rows, "chamfer_pct"), front=True),
        Panel("Normal error", spent, "degrees", _series(rows, "normal_deg"), front=True),
        Panel("F-score at 1 % of the diagonal", spent, "F1", _series(rows, "fscore"), log_y=False),
        Panel("PSNR on held-out photos", spent, "dB", _series(rows, "psnr"), log_y=False),
    ]
    write(path, f"Error against time: {capture}", panels)
