"""Scaling of time with photos, surfels and resolution: doubling photos or surfels may take at most 2.2 times as long.

python -m benchmarks.growth [--parts photos,surfels,resolution] [--photos 12,24,48,96] [--surfels 10000,20000,…] [--resolutions 200,400,800]

Photos: bakes of the built-in capture with that many photos and fixed training iterations, up to the asset; every stage and their
sum. Surfels: a training iteration on one photo of 512² pixels (`benchmarks.step`), the median of several. Resolution: the same with
20 000 surfels, and the stereo stage on 12 photos of the built-in capture.
Seconds are wall time (CPU time for an iteration on one thread), so the machine should be idle; `--rounds` repeats the bakes and takes the
fastest. Writes benchmarks/results/growth.csv and docs/lab/growth.svg.

`per_doubling` is the factor in time per doubling of the size, computed from a size and the one before it; for resolutions, of the pixels.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from benchmarks.charts import COLOURS, Panel, Series, write
from benchmarks.csv_rows import today
from benchmarks.step import profile
from gsbake.api import RunOptions, open_session
from gsbake.kernels.threads import configure
from gsbake.pipeline.machine import default_threads
from gsbake.synth.capture import write_capture

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "growth.csv"
CHART = ROOT / "docs" / "lab" / "growth.svg"
#: Maximum factor in time when photos or surfels double.
MAX_DOUBLING_COST = 2.2
#: Edge of the photos of the bakes in pixels, and their training iterations.
BAKE_EDGE, BAKE_ITERATIONS = 400, 100
#: Photo edge of the curves over surfels; surfels and photos of the curves over resolution.
STEP_EDGE, STEP_SURFELS, STEREO_PHOTOS = 512, 20_000, 12
STAGES = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export")
UNITS = {"photos": "photos", "surfels": "surfels", "resolution": "photo edge, pixels"}


@dataclass(frozen=True)
class Cell:
    """One measured size: `per_doubling` is None for the smallest size of a curve, `peak_mb` where only a step was timed."""

    axis: str
    what: str
    size: int
    seconds: float
    peak_mb: float | None = None
    per_doubling: float | None = None
    date: str = field(default_factory=today)


def per_doubling(before: tuple[float, float], after: tuple[float, float]) -> float:
    """Factor in time per doubling of the work between two (work, seconds), under a power law."""
    return float((after[1] / before[1]) ** (math.log(2) / math.log(after[0] / before[0])))


def with_doublings(cells: Sequence[Cell]) -> list[Cell]:
    """The cells by curve and size, each with the factor per doubling from the size before it."""
    out: list[Cell] = []
    for cell in sorted(cells, key=lambda c: (c.axis, c.what, c.size)):
        last = out[-1] if out and (out[-1].axis, out[-1].what) == (cell.axis, cell.what) else None
        power = 2 if cell.axis == "resolution" else 1
        ratio = None if last is None else per_doubling((last.size**power, last.seconds), (cell.size**power, cell.seconds))
        out.append(replace(cell, per_doubling=ratio))
    return out


def bake(photos: int, edge: int, until: str, out: Path, threads: int, rounds: int) -> dict[str, tuple[float, float]]:
    """Seconds and peak megabytes of every stage up to `until`: the fastest of `rounds` bakes of the built-in capture."""
    capture = out / f"capture-{photos}-{edge}"
    if not (capture / "transforms.json").is_file():
        write_capture(capture, photos, edge)
    overrides = [
        f"ingest.max_size={edge}",
        f"stereo.max_size={edge}",
        "stereo.enabled=always",
        f"train.iterations={BAKE_ITERATIONS}",
        f"refine.iterations={BAKE_ITERATIONS // 5}",
        "skip.confirmed_steps=keep",
        "skip.redundant_photos=keep",
        "skip.resolution=keep",
        "skip.converged_steps=keep",
    ]
    best: dict[str, tuple[float, float]] = {}
    for number in range(rounds):
        folder = out / f"round-{number}" / f"{photos}-{edge}"
        options = RunOptions(photos=capture, out=folder, profile="preview", overrides=overrides, device="cpu", threads=threads)
        for state in open_session(options).engine.run(until):
            assert state.artifact is not None  # the engine returned, so every stage is finished
            found = float(state.artifact.manifest["seconds"]), state.artifact.manifest["peak_bytes"] / 1e6
            best[state.name] = min(found, best.get(state.name, found))
    return best


def photo_cells(counts: Sequence[int], out: Path, threads: int, rounds: int) -> Iterator[Cell]:
    """Every stage and the whole bake over the number of photos."""
    for count in counts:
        stages = bake(count, BAKE_EDGE, STAGES[-1], out, threads, rounds)
        for name in STAGES:
            yield Cell("photos", name, count, *stages[name])
        yield Cell("photos", "whole bake", count, sum(s for s, _ in stages.values()), max(p for _, p in stages.values()))


def surfel_cells(counts: Sequence[int], repeats: int) -> Iterator[Cell]:
    """A training iteration over the number of surfels, with colours and with materials and environment map."""
    for materials, what in ((False, "step, colours"), (True, "step, materials")):
        for count in counts:
            yield Cell("surfels", what, count, profile(count, STEP_EDGE, materials, repeats)["step"] / 1e3)


def resolution_cells(edges: Sequence[int], out: Path, threads: int, repeats: int, rounds: int) -> Iterator[Cell]:
    """A training iteration and the stereo stage over the photos' edge."""
    for edge in edges:
        yield Cell("resolution", "step, colours", edge, profile(STEP_SURFELS, edge, False, repeats)["step"] / 1e3)
        yield Cell("resolution", "stereo", edge, *bake(STEREO_PHOTOS, edge, "stereo", out, threads, rounds)["stereo"])


def read_csv(path: Path) -> list[Cell]:
    """The cells of a CSV file written by `write_csv`; none when it does not exist."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [
            Cell(
                line["axis"], line["what"], int(line["size"]), float(line["seconds"]),
                float(line["peak_mb"]) if line["peak_mb"] else None, date=line["date"],
            )  # fmt: skip
            for line in csv.DictReader(file)
        ]


def write_csv(path: Path, cells: Sequence[Cell]) -> None:
    """Write cells with their doublings."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Cell)], lineterminator="\n")
        writer.writeheader()
        for cell in cells:
            writer.writerow({k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(cell).items()})


def panel(axis: str, cells: Sequence[Cell]) -> Panel:
    """The slowest curves over one axis, as many as there are colours, and the allowed time from the first size of the slowest."""
    curves: dict[str, list[Cell]] = {}
    for cell in cells:
        if cell.axis == axis:
            curves.setdefault(cell.what, []).append(cell)
    shown = sorted(curves.items(), key=lambda item: -item[1][-1].seconds)[: len(COLOURS) - 1]
    series = [Series(f"{axis}: {what}", [(c.size, c.seconds) for c in curve], i) for i, (what, curve) in enumerate(shown)]
    if shown:
        first, last = shown[0][1][0], shown[0][1][-1]
        doublings = math.log2(last.size / first.size) * (2 if axis == "resolution" else 1)
        allowed = [(first.size, first.seconds), (last.size, first.seconds * MAX_DOUBLING_COST**doublings)]
        series.append(Series(f"{MAX_DOUBLING_COST} times a doubling", allowed, len(COLOURS) - 1, "dash"))
    return Panel(f"Time over {axis}", UNITS[axis], "seconds", series)


def summary(cells: Sequence[Cell]) -> str:
    """The largest factor per doubling of every curve, compared with MAX_DOUBLING_COST for photos and surfels."""
    worst: dict[tuple[str, str], float] = {}
    for cell in cells:
        if cell.per_doubling is not None:
            key = cell.axis, cell.what
            worst[key] = max(cell.per_doubling, worst.get(key, 0.0))
    lines = []
    for (axis, what), ratio in worst.items():
        verdict = "" if axis == "resolution" else f"  {'within' if ratio <= MAX_DOUBLING_COST else 'OVER'} {MAX_DOUBLING_COST}"
        lines.append(f"{axis:12} {what:18} doubling takes at most {ratio:5.2f} times as long{verdict}\n")
    return "".join(lines)


def integers(text: str) -> list[int]:
    """Parse comma-separated sizes."""
    return [int(v) for v in text.split(",")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print as it goes, write the CSV and the chart."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=lambda s: s.split(","), default=list(UNITS))
    parser.add_argument("--photos", type=integers, default=[12, 24, 48, 96])
    parser.add_argument("--surfels", type=integers, default=[10_000, 20_000, 40_000, 80_000, 160_000, 320_000, 400_000])
    parser.add_argument("--resolutions", type=integers, default=[200, 400, 800])
    parser.add_argument("--repeats", type=int, default=9, help="training iterations whose median is taken")
    parser.add_argument("--rounds", type=int, default=1, help="bakes of which the fastest counts")
    parser.add_argument("--threads", type=int, default=default_threads())
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "bench" / "growth", help="folder of the bakes; finished ones are reused"
    )
    parser.add_argument("--csv", type=Path, default=RESULTS)
    parser.add_argument("--chart", type=Path, default=CHART)
    args = parser.parse_args(arguments)
    configure(args.threads)
    parts: Mapping[str, Iterator[Cell]] = {
        "photos": photo_cells(args.photos, args.out, args.threads, args.rounds),
        "surfels": surfel_cells(args.surfels, args.repeats),
        "resolution": resolution_cells(args.resolutions, args.out, args.threads, args.repeats, args.rounds),
    }
    cells = [cell for cell in read_csv(args.csv) if cell.axis not in args.parts]
    for part in args.parts:
        for cell in parts[part]:
            sys.stdout.write(f"{cell.axis:12} {cell.what:18} {cell.size:8d}  {cell.seconds:10.4f} s\n")
            sys.stdout.flush()
            cells.append(cell)
    cells = with_doublings(cells)
    write_csv(args.csv, cells)
    write(args.chart, "Cost of doubling", [panel(axis, cells) for axis in UNITS], columns=3)
    sys.stdout.write(summary(cells))


if __name__ == "__main__":
    main()
