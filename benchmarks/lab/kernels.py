"""Tables of time: error against time, growth with size, kernels on the CPU and on a GPU, float32 against float64, equal bytes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Line, Maker, Table, newest, number, read
from benchmarks.rows import Row, front, read_csv, text

PASSES = ("forward", "backward", "step", "rest")
GROWTH = (("photos", "whole bake"), ("photos", "stereo"), ("surfels", "step, colours"), ("surfels", "step, materials"),
          ("resolution", "step, colours"), ("resolution", "stereo"))  # fmt: skip


def _dated(row: Row) -> Line:
    return {"date": row.date}


def time(results: Path) -> Table:
    """Pareto fronts of error and time."""
    measured = read_csv(results / "timeline.csv")
    kept = [row for capture in sorted({row.capture for row in measured}) for row in front(r for r in measured if r.capture == capture)]
    rows = []
    for row in kept:
        figures = text(row.seconds, ".0f"), text(row.chamfer_pct, ".3f"), text(row.fscore, ".3f"), text(row.normal_deg, ".1f")
        rows.append([row.capture, row.name, text(row.steps, "d"), *figures])
    headings = ("capture", "made by", "steps", "seconds", "Chamfer %", "F at 1 %", "normals °")
    return Table('make bench PARTS=timeline ARGS="--shares 0,0.15,1"', headings, rows, [_dated(row) for row in kept])


def growth(results: Path) -> Table:
    """Smallest and largest size of each curve, and what doubling costs at most."""
    measured = newest(read(results, "growth"), "axis", "what", "size")
    rows, lines = [], []
    for axis, what in GROWTH:
        curve = sorted((x for x in measured if (x["axis"], x["what"]) == (axis, what)), key=lambda x: int(x["size"]))
        most = max(float(line["per_doubling"]) for line in curve[1:])
        ends = f"{curve[0]['size']} to {curve[-1]['size']}"
        spent = f"{float(curve[0]['seconds']):.3g} to {float(curve[-1]['seconds']):.3g}"
        rows.append([{"resolution": "photo edge, pixels"}.get(axis, axis), ends, what, spent, f"{most:.2f}"])
        lines += curve
    headings = ("doubled", "sizes", "of", "seconds", "at most, per doubling")
    return Table("make bench PARTS=growth", headings, rows, lines)


def raster(results: Path) -> Table:
    """Milliseconds of the rasteriser's passes and of a training step."""
    lines = [x for x in newest(read(results, "raster"), "surfels", "size", "channels", "pass") if x["channels"] == "10"]
    rows = []
    for key in dict.fromkeys((x["surfels"], x["size"]) for x in lines):
        found = {x["pass"]: x["ms"] for x in lines if (x["surfels"], x["size"]) == key}
        rows.append([*key, *(number(found.get(name, ""), 0) for name in PASSES)])
    headings = ("surfels", "size", "forward ms", "backward ms", "step ms", "of which rest ms")
    return Table('make bench PARTS=table ARGS="--threads 1"', headings, rows, lines)


def device(results: Path) -> Table:
    """Milliseconds of the GPU's kernels."""
    lines = newest(read(results, "device"), "surfels", "size")
    rows = [
        [line["surfels"], line["size"], number(line["forward_ms"], 1), number(line["backward_ms"], 1), number(line["peak_mb"], 0)]
        for line in lines
    ]
    return Table("python -m benchmarks.device --csv FILE", ("surfels", "size", "forward ms", "backward ms", "memory MB"), rows, lines)


def precision(results: Path) -> Table:
    """Error of the float32 kernels by scale, the worst over the fields of view."""
    lines = read(results, "numerics")
    rows = []
    for scale in dict.fromkeys(line["scale"] for line in lines):
        worst = {c: max(float(x[c]) for x in lines if x["scale"] == scale) for c in ("colour", "other", "off")}
        rows.append([f"{float(scale):g}", f"{worst['colour']:.0e}", f"{worst['other']:.0e}", f"{100 * worst['off']:.2g}"])
    headings = ("scale", "colours", "worst other plane", "pixels off by 1e-4, %")
    return Table("python -m benchmarks.numerics", headings, rows, lines)


def bytes_(results: Path) -> Table:
    """Files of all stages that differ between runs."""
    lines = read(results, "reproducibility")
    rows = []
    for capture, profile, threads in dict.fromkeys((x["capture"], x["profile"], x["threads"]) for x in lines):
        found = [x for x in lines if (x["capture"], x["profile"], x["threads"]) == (capture, profile, threads)]
        counts = (str(sum(int(x[column]) for x in found)) for column in ("files", "different"))
        rows.append([capture, profile, f"{found[0]['stage']} to {found[-1]['stage']}", threads.replace(" ", ", "), *counts])
    headings = ("capture", "profile", "stages", "threads", "files", "that differ")
    command = "python -m benchmarks.reproducibility CAPTURE --runs 2 --threads 2 --threads 1 --until export --profile smoke"
    return Table(command, headings, rows, lines)


TABLES: Mapping[str, Maker] = {
    "time": time, "growth": growth, "raster": raster, "device": device, "precision": precision, "bytes": bytes_,
}  # fmt: skip
