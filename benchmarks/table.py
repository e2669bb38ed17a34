"""Table of kernel times: forward, backward and a training iteration over sizes, and machine-independent ratios.

python -m benchmarks.table [--surfels 10000,50000,200000] [--sizes 256,512,800] [--channels 3,10] [--csv benchmarks/results/raster.csv]

Every time is the median of a few rounds, in milliseconds: CPU time with one thread, wall time with more. `x copy` is its ratio to a plain
numpy copy of the minimum bytes that the pass reads and writes (surfels, planes, gradients; the optimiser's state in a step). The PyTorch
reference blends one surfel after the other over whole images, so it is timed on a small scene only, the first rows (`x twin`: its time over
that of the kernels).

The step is a training iteration on one photo, in the middle of a run (full resolution, all losses; see `benchmarks.step`): with the
smallest channel count it trains colours (3 channels and the normal), with a larger one materials under an environment map (5 and the
normal). `rest` is the time of neither rasterisation nor shading.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.csv_rows import today
from benchmarks.raster import sphere
from benchmarks.step import profile
from gsbake.kernels.threads import configure, thread_count
from gsbake.surfels.raster.rasterise import render
from gsbake.surfels.raster.reference import render_reference

RESULTS = Path(__file__).parent / "results" / "raster.csv"
COLUMNS = ("surfels", "size", "channels", "pass", "ms", "x_copy", "x_twin", "threads", "date")
SMALL = (500, 64, 3)


def now() -> float:
    """Seconds: CPU time with one thread (the processor may be shared), wall time with more."""
    return time.process_time() if thread_count() == 1 else time.perf_counter()


def median_ms(call: Callable[[], float], repeats: int) -> float:
    """Median in milliseconds of the seconds that `call` returns, after two warm-up rounds."""
    return statistics.median([1e3 * call() for _ in range(repeats + 2)][2:])


def copy_ms(size: int, repeats: int) -> float:
    """Milliseconds of a numpy copy of `size` bytes."""
    source, target = np.ones(size // 4, np.float32), np.zeros(size // 4, np.float32)

    def once() -> float:
        start = now()
        np.copyto(target, source)
        return now() - start

    return median_ms(once, max(9, repeats))


def passes(surfels: int, size: int, channels: int, repeats: int, reference: bool = False) -> tuple[float, float]:
    """Milliseconds of forward and backward on the sphere of `benchmarks.raster`, of the kernels or the PyTorch reference."""
    inputs, pinhole, rotation, translation = sphere(surfels, channels, size)
    inputs = [x.requires_grad_() for x in inputs]
    forward, backward = [], []
    for _ in range(repeats + 1):
        start = now()
        if reference:
            planes = render_reference(*inputs, rotation, translation, pinhole)
        else:
            out = render(*inputs, rotation, translation, pinhole, normals_as_features=False)
            planes = {k: getattr(out, k) for k in ("features", "depth", "distortion", "alpha")}
        forward.append(1e3 * (now() - start))
        loss = planes["features"].sum() + planes["depth"].sum() + planes["distortion"].sum() + planes["alpha"].sum()
        start = now()
        loss.backward()
        backward.append(1e3 * (now() - start))
        for x in inputs:
            x.grad = None
    return statistics.median(forward[1:]), statistics.median(backward[1:])


def state_floats(surfels: int, materials: bool) -> int:
    """Optimised floats: position, quaternion, two scales, SDF sample, and 4 spherical harmonics of 3 colours or 5 material channels."""
    return surfels * (10 + (5 if materials else 12)) + 1


def min_bytes(surfels: int, size: int, channels: int) -> tuple[int, int]:
    """Minimum bytes that forward and backward read or write: surfels, output planes, their gradients."""
    surfel, pixels = 4 * surfels * (10 + channels), 4 * size * size
    return surfel + pixels * (channels + 6), 2 * surfel + pixels * (2 * channels + 9)


def rows(surfels: int, size: int, channels: int, materials: bool, repeats: int) -> list[dict[str, object]]:
    """The rows of one combination of sizes."""
    forward, backward = passes(surfels, size, channels, repeats)
    step = profile(surfels, size, materials, repeats)
    read, back = min_bytes(surfels, size, channels)
    cell = {"surfels": surfels, "size": size, "channels": channels, "x_twin": "", "threads": thread_count(), "date": today()}
    all_ = read + back + 16 * state_floats(surfels, materials)
    figures = (("forward", forward, read), ("backward", backward, back), ("step", step["step"], all_))
    made = [cell | {"pass": k, "ms": round(ms, 2), "x_copy": round(ms / copy_ms(b, repeats), 1)} for k, ms, b in figures]
    return [*made, cell | {"pass": "rest", "ms": round(step["rest"], 2), "x_copy": ""}]


def small_rows() -> list[dict[str, object]]:
    """Rows of the small scene, with the ratio to the PyTorch reference."""
    ours, reference = passes(*SMALL, repeats=9), passes(*SMALL, repeats=2, reference=True)
    cell = {"surfels": SMALL[0], "size": SMALL[1], "channels": SMALL[2], "threads": thread_count(), "date": today()}
    made = []
    for name, ms, slow, size in zip(("forward", "backward"), ours, reference, min_bytes(*SMALL), strict=True):
        made.append(cell | {"pass": name, "ms": round(ms, 2), "x_copy": round(ms / copy_ms(size, 9), 1), "x_twin": round(slow / ms, 1)})
    return made


def line(row: dict[str, object]) -> str:
    """One row of the printed table."""
    return "".join(str(row[c]).rjust(max(9, len(c) + 2)) for c in COLUMNS) + "\n"


def main() -> None:
    """Measure, print every row, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, values in (("surfels", "10000,50000,200000"), ("sizes", "256,512,800"), ("channels", "3,10")):
        parser.add_argument(f"--{name}", type=lambda s: [int(v) for v in s.split(",")], default=[int(v) for v in values.split(",")])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=thread_count(), help="kernel threads (default: as many as torch would use)")
    parser.add_argument("--csv", type=Path, default=RESULTS)
    args = parser.parse_args()
    configure(args.threads)
    sys.stdout.write(line({c: c.replace("_", " ") for c in COLUMNS}))
    table = small_rows()
    sys.stdout.writelines(line(row) for row in table)
    for surfels in args.surfels:
        for size in args.sizes:
            for channels in args.channels:
                made = rows(surfels, size, channels, channels > min(args.channels), args.repeats)
                sys.stdout.writelines(line(row) for row in made)
                sys.stdout.flush()
                table += made
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    with args.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
