"""Rows of `benchmarks.ceiling`: what right maps would reach on a run's mesh, and how a figure is printed beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from benchmarks.csv_rows import read_rows, today

RESULTS = Path(__file__).parent / "results" / "ceiling.csv"
#: Maps on the mesh of a run: its own; the true ones under its normals; the true ones under true normals.
OWN, TRUE, TRUE_NORMALS = "own", "true", "true+normals"
#: A ceiling holds for meshes whose Chamfer distance differs by no more than this share.
SAME_SHAPE = 0.02


@dataclass(frozen=True)
class Row:
    """One asset scored on `views` of the reference's views (0: all); figures as in `benchmarks.objects`; all `maps` share one mesh."""

    object: str
    maps: str
    views: int
    commit: str
    chamfer_pct: float
    normal_deg: float
    relit: float
    relit_scaled: float
    base: float
    base_scaled: float
    roughness: float
    metallic: float
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one key replace each other."""
        return self.object, self.maps, str(self.views), self.commit


def newest(name: str, path: Path = RESULTS, views: int = 0) -> dict[str, Row]:
    """{maps: row} of an object or capture scored on `views`, measured last; none where it was not measured."""
    found: dict[str, Row] = {}
    for row in read_rows(path, Row):
        if row.object == name and row.views == views and (row.maps not in found or row.date >= found[row.maps].date):
            found[row.maps] = row
    return found


def ceilings(name: str, chamfer_pct: float, path: Path = RESULTS) -> dict[str, Row]:
    """`newest`, where its mesh has the shape of one with this Chamfer distance; else none."""
    return {maps: row for maps, row in newest(name, path).items() if abs(row.chamfer_pct - chamfer_pct) <= SAME_SHAPE * chamfer_pct}


def beside(figure: float, ceiling: Row | None, column: str, digits: int) -> str:
    """A figure of one `column`, after a slash its ceiling where there is one."""
    return f"{figure:.{digits}f}" + (f"/{getattr(ceiling, column):.{digits}f}" if ceiling else "")


def beside_pair(figure: Callable[[str], float], ceiling: Row | None, column: str) -> str:
    """`beside` of a column in dB, and in brackets of the one with a gain per channel."""
    return f"{beside(figure(column), ceiling, column, 1)} ({beside(figure(column + '_scaled'), ceiling, column + '_scaled', 1)})"


def markdown(rows: Sequence[Row]) -> str:
    """A line per object: shape, and what own and true maps reach relit and in base colour."""
    lines = [
        "| object | Chamfer % | normal ° | relit dB, own maps | true maps | and true normals | base colour dB, own | true |",
        "|---" * 8 + "|",
    ]
    for name in dict.fromkeys(row.object for row in rows):
        known = {row.maps: row for row in rows if row.object == name}
        shape = next(iter(known.values()))
        shown = [(maps, "relit") for maps in (OWN, TRUE, TRUE_NORMALS)] + [(maps, "base") for maps in (OWN, TRUE)]
        cells = [name, f"{shape.chamfer_pct:.3f}", f"{shape.normal_deg:.1f}"]
        for maps, column in shown:
            row = known.get(maps)
            cells.append(beside_pair(partial(getattr, row), None, column) if row else "–")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
