"""What carving does to the visual hull, and how well silhouettes tell where it lies on the object.

python -m benchmarks.hull RUN CAPTURE [RUN CAPTURE …]

RUN is the folder of a run whose stages `poses` and `stereo` are finished, all photos with masks; CAPTURE has the ground truth in `gt/`. The
first table has accuracy and completeness (`benchmarks.truth`, % of the true diagonal, visible surfaces only) of the hull and of the carved
hull. The second has the share of the hull's voxels at its surface that are hard and soft (`gsbake.capture.hull.softness`), and how many of
them lie more than two voxels off the true surface, where there is air behind them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.captures import report_runs
from benchmarks.truth import Figures, Surface, align, measure, nearest, read_centres, read_truth
from gsbake.capture.hull.softness import SOFT, surface_softness
from gsbake.capture.hull.visual_hull import Hull, read_masks, unit_hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import UsageError
from gsbake.pipeline.store import Store

#: Limits of the softness in the second table, and voxels from the truth that count as off.
SOFTNESS, OFF = (0.0, 0.6, 0.9, SOFT, 1.4, 2.0, np.inf), 2.0


@dataclass(frozen=True)
class HullFigures:
    """Figures of the hull and of the carved one; `shares` (k,) of the surface by softness, and of which `off` (k,) is off."""

    hull: Figures
    carved: Figures
    shares: NDArray[np.float64]
    off: NDArray[np.float64]


def measure_hulls(run: Path, capture: Path) -> HullFigures:
    """Figures of a run. Raises UsageError when a stage is not finished or has no hull."""
    return measure_folders(*finished_stages(run), capture)


def finished_stages(run: Path) -> tuple[Path, Path]:
    """Folders of the run's stages poses and stereo. Raises UsageError when one is not finished."""
    store = Store(run)
    known = {name: store.manifests(name) for name in ("poses", "stereo")}
    if missing := [name for name in known if not known[name]]:
        raise UsageError(f"{run} has no finished stage {missing[0]}; run `gsbake stereo` first.")
    return known["poses"][0][0], known["stereo"][0][0]


def measure_folders(poses: Path, stereo: Path, capture: Path) -> HullFigures:
    """Figures of the folders of finished stages. Raises UsageError when there is no hull."""
    if not (stereo / "hull.npz").exists():
        raise UsageError(f"{stereo} has no visual hull: not all photos have masks.")
    posed, truth = PosedPhotos.open(poses), read_truth(capture)
    masks = read_masks(posed)
    hull, frame = unit_hull(*masks), posed.cameras.to_world
    carved = Surface(*Hull.load(stereo / "hull.npz").triangles())
    if posed.cameras.poses != "given":
        frame = frame.then(align(carved.moved(frame), read_centres(poses / "cameras.json"), truth))
    cells = np.argwhere(hull.occupancy & ~ndimage.binary_erosion(hull.occupancy))
    softness = surface_softness(hull, *masks)[tuple(cells.T)]
    distance = nearest(frame.apply(hull.lower + (cells + 0.5) * hull.cell), truth.surface, 0)[0]
    off = distance > OFF * hull.cell * frame.scale
    bins = np.digitize(softness, SOFTNESS) - 1
    count = np.bincount(bins, minlength=len(SOFTNESS) - 1)
    return HullFigures(
        measure(Surface(*hull.triangles()).moved(frame), truth),
        measure(carved.moved(frame), truth),
        count / count.sum(),
        np.bincount(bins, off, len(SOFTNESS) - 1) / np.maximum(count, 1),
    )


def tables(found: dict[str, HullFigures]) -> str:
    """Both tables as Markdown."""
    lines = ["| capture | accuracy % | completeness % | chamfer % |", "|---|---|---|---|"]
    for name, one in found.items():
        pairs = ((getattr(one.hull, key), getattr(one.carved, key)) for key in ("accuracy_pct", "completeness_pct", "chamfer_pct"))
        lines.append(f"| {name} | " + " | ".join(f"{before:.2f} → {after:.2f}" for before, after in pairs) + " |")
    limits = [f"{low:g} to {high:g}" for low, high in zip(SOFTNESS[:-2], SOFTNESS[1:-1], strict=True)] + [f"{SOFTNESS[-2]:g} and more"]
    lines += ["", "| capture | " + " | ".join(limits) + " |", "|---" * (len(limits) + 1) + "|"]
    for name, one in found.items():
        lines.append(f"| {name} | " + " | ".join(f"{s:.2f}, {o:.2f}" for s, o in zip(one.shares, one.off, strict=True)) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def report(pairs: Sequence[tuple[Path, Path]]) -> str:
        return tables({capture.name: measure_hulls(run, capture) for run, capture in pairs})

    return report_runs("hull", __doc__, report, arguments)


if __name__ == "__main__":
    sys.exit(main())
