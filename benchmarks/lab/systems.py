"""Tables of the systems with a distance: their shape by capture, few photos, what the distance does."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Line, Maker, Table, mean, newest, number, read, spaced

COMMAND = "python -m benchmarks.fields --captures CAPTURE --systems SYSTEM"
CAPTURES = ("built-in", "boombox", "avocado", "brass_vase", "stool", "mixer", "racquet")


def _rows(results: Path) -> list[Line]:
    return newest(read(results, "fields"), "capture", "system", "settings", "seed")


def chamfer(results: Path) -> Table:
    """Chamfer distance (seed 0): a system a row, a capture a column."""
    lines = [x for x in _rows(results) if x["capture"] in CAPTURES and not x["settings"] and x["seed"] == "0"]
    known = {(line["system"], line["capture"]): line for line in lines}
    systems = sorted({line["system"] for line in lines}, key=lambda name: (name != "default", name))
    rows = [[name, *(number(known[name, capture]["chamfer_pct"], 3) for capture in CAPTURES)] for name in systems]
    return Table(COMMAND, ("system", *map(spaced, CAPTURES)), rows, lines)


def few_photos(results: Path) -> Table:
    """Systems that were measured with several seeds on 8 photos of boombox."""
    lines = [x for x in _rows(results) if x["capture"] == "boombox:8" and not x["settings"]]
    systems = [name for name in dict.fromkeys(x["system"] for x in lines) if sum(x["system"] == name for x in lines) > 1]
    rows = []
    for name in systems:
        found = [float(line["chamfer_pct"]) for line in sorted(lines, key=lambda x: x["seed"]) if line["system"] == name]
        rows.append([name, ", ".join(f"{v:.3f}" for v in found), f"{statistics.mean(found):.3f}", f"{statistics.median(found):.3f}"])
    headings = ("system", "Chamfer % by seed", "mean", "median")
    command = "python -m benchmarks.fields --captures boombox:8 --seeds 0,1,2"
    return Table(command, headings, rows, [line for line in lines if line["system"] in systems])


def distance(results: Path) -> Table:
    """What the distance does at the end of training, mean over seeds."""
    lines = [line for line in read(results, "distance") if float(line["share"]) == 1]
    rows = []
    for system, given in dict.fromkeys((line["system"], line["settings"]) for line in lines):
        found = [line for line in lines if (line["system"], line["settings"]) == (system, given)]
        shift, correlation, opacity = (mean(found, column) for column in ("shift", "correlation", "opacity"))
        rows.append([f"{system} {given}".strip(), str(len(found)), f"{shift:.4f}", f"{correlation:.2f}", f"{opacity:.4f}"])
    headings = ("system", "seeds", "shift of the depth, voxels", "correlation with true distances", "median opacity")
    return Table("python -m benchmarks.distance --systems default,dsdf --seeds 0,1,2", headings, rows, lines)


TABLES: Mapping[str, Maker] = {
    "systems, Chamfer": chamfer, "few photos": few_photos, "distance": distance,
}  # fmt: skip
