"""The table of the README: two captures, what gsbake takes and reaches, and what another program does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Line, Maker, Table, newest, number, read

#: What is said of the captures, and which of them another program could not bake.
CAPTURES = {"boombox": "boombox: glossy, 48 renders of 400², poses given", "avocado": "avocado: diffuse, 40 renders of 640 × 480, no poses"}
FAILED = "failed"


def _cells(line: Line, first: bool) -> list[str]:
    quoted = line["source"] == "quoted"
    made = f"{line['made_by']} (quoted)" if quoted else f"`{line['made_by']}`"
    name = CAPTURES[line["capture"]] if first else ""
    if not line["seconds"]:
        return [name, made, FAILED, "–", "–", "–", "–", "–"]
    memory = f"{number(line['peak_mb'], 1, 1e-3)} GB" if line["peak_mb"] else "–"
    figures = number(line["chamfer_pct"], 2), number(line["normal_deg"], 1), number(line["relit_scaled"], 1), number(line["base_scaled"], 1)
    return [name, made, number(line["seconds"], 1, 1 / 60), memory, *figures]


def headline(results: Path) -> Table:
    """The newest row of each capture and program."""
    lines = newest(read(results, "headline"), "capture", "made_by")
    rows = []
    for capture in CAPTURES:
        own = sorted((line for line in lines if line["capture"] == capture), key=lambda line: (line["source"] == "quoted", line["made_by"]))
        rows += [_cells(line, first=k == 0) for k, line in enumerate(own)]
    headings = ("capture", "made by", "minutes", "memory", "Chamfer %", "normals °", "relit dB", "base colour dB")
    return Table("python -m benchmarks.headline OUT", headings, rows, [line for line in lines if line["source"] == "measured"] or lines)


TABLES: Mapping[str, Maker] = {"headline": headline}
