"""Tables of many captures: a batch on one machine, and simulated farms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Maker, Table, number, read

WAYS = {"loop": "a loop of `gsbake run`", "one": "`gsbake batch`, one worker", "two": "`gsbake batch`, two workers"}
COMMAND = "python -m benchmarks.farm"


def batch(results: Path) -> Table:
    """A batch beside a loop."""
    lines = read(results, "batch")
    rows = [
        [WAYS[x["way"]], x["captures"], number(x["wall"], 0), number(x["cpu"], 0), number(x["jobs"], 0), number(x["busy"], 1, 100)]
        for x in lines
    ]
    headings = ("way", "captures", "wall s", "CPU s", "s of jobs", "workers busy %")
    return Table("python -m benchmarks.batch --captures 4 --rounds 1", headings, rows, lines)


def packing(results: Path) -> Table:
    """Jobs of one stage, of many, and of whole captures, for 1 000 captures on 100 nodes."""
    lines = [line for line in read(results, "farm") if line["part"] == "packing" and line["captures"] == "1000"]
    rows = []
    for line in lines:
        seconds = float(line["pack_seconds"])
        jobs = {0.0: "a stage", float("inf"): "a capture"}.get(seconds, f"{seconds:.0f} s")
        figures = [number(line["efficiency"], 3), *(number(line[name], 1, 100) for name in ("overhead", "idle"))]
        rows.append([jobs, number(line["hours"], 2), *figures, line["jobs"]])
    headings = ("jobs of", "hours", "efficiency", "starting %", "idle %", "jobs")
    return Table(COMMAND, headings, rows, lines)


def size(results: Path) -> Table:
    """Farms of other sizes."""
    lines = [line for line in read(results, "farm") if line["part"] == "size"]
    rows = []
    for line in lines:
        shares = (number(line[name], 1, 100) for name in ("idle", "store_use", "coordinator_use"))
        figures = number(line["hours"], 2), number(line["efficiency"], 3), *shares, number(line["gigabytes"], 0)
        rows.append([line["captures"], line["nodes"], *figures])
    headings = ("captures", "nodes", "hours", "efficiency", "idle %", "store in use %", "coordinator in use %", "GB moved")
    return Table(COMMAND, headings, rows, lines)


TABLES: Mapping[str, Maker] = {"batch": batch, "packing": packing, "farm size": size}
