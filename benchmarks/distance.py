"""What the distance of a field system does in training: how much it moves the rendered depth, and how well it is a distance.

python -m benchmarks.distance [--captures built-in,boombox] [--systems dsdf,default] [--seeds 0,1,2] [--set key=value …] [--out DIR]
    [--csv FILE]

A training run (sizes of the profile `preview`) is stopped at shares of its iterations, as Ctrl-C stops one, its checkpoint is read, and it
goes on from there. At each stop, over the cameras of photos evenly chosen:

* shift: median |D − D₀| in voxels of the mesh, D the rendered depth and D₀ that with every distance set to 0 (all surfels opaque, none
  moved), where both render a surface;
* correlation: Pearson's, of the surfels' distances and their true signed distances to the ground truth, for surfels within three spacings
  of it. The sign of the truth is that of the nearest face's normal;
* opacity: the median of the surfels.

Rows carry commit, host and seed, and replace older ones of the same capture, system, settings, seed and share.
"""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.csv_rows import current_commit, today
from benchmarks.fields import KEY, parse, run_options, write
from benchmarks.timeline import ROOT
from benchmarks.truth import Surface, camera_frame, nearest, nearest_on_faces, read_centres, read_truth
from gsbake.api import open_session
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.checkpoint import load_checkpoint
from gsbake.config.schema import Profile
from gsbake.errors import InterruptedRun, UsageError
from gsbake.meshing.resolution import choose_resolution, pixel_footprint
from gsbake.monitor import SilentMonitor
from gsbake.surfels.model import Surfels
from gsbake.surfels.renderer import SurfelRenderer
from gsbake.surfels.spacing import surfel_spacing, typical_spacing
from gsbake.surfels.training.run import train_surfels
from gsbake.surfels.training.session import TrainOptions
from gsbake.surfels.transfer import transfer_by_name

RESULTS = ROOT / "benchmarks" / "results" / "distance.csv"
DEFAULT_SYSTEMS = ("default", "dsdf")
#: Shares of the iterations at which a run is stopped; the last is its end.
SHARES = (0.25, 0.5, 0.75, 1.0)
#: Photos whose depth is rendered.
PHOTOS = 8
#: Surfels farther from the true surface, in spacings, do not count for the correlation: they are errors of initialisation.
MAX_SPACINGS = 3.0
#: Alpha above which a pixel shows a surface.
MIN_ALPHA = 0.5


@dataclass(frozen=True)
class Row:
    """One stop of one run; `shift` in voxels."""

    capture: str
    system: str
    settings: str
    seed: int
    share: float
    shift: float
    correlation: float
    opacity: float
    spacing_cells: float
    surfels: int
    counts: str
    commit: str = ""
    host: str = ""
    date: str = field(default_factory=today)


class StopAt(SilentMonitor):
    """Requests a stop as soon as a share of the iterations is done."""

    def __init__(self, share: float) -> None:
        """`share` of 1 never stops a run."""
        self.share, self.reached = share, False

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        """Notice the share."""
        self.reached = self.share < 1 and done >= self.share * total

    def stop_requested(self) -> bool:
        """Whether the share is reached."""
        return self.reached

    def check_stop(self) -> None:
        """Stop there."""
        if self.reached:
            raise InterruptedRun(f"stopped after {self.share:.0%} of the iterations")


def training_options(p: Profile) -> TrainOptions:
    """What the stage train takes of a profile, with all iterations: steps are not skipped, so that shares compare."""
    return TrainOptions(p.train, p.surfels, p.loss, p.light.size, "keep", "keep", "keep", "keep", field=p.field, coupling=p.coupling)


def depth_shift(surfels: Surfels, posed: PosedPhotos, photos: Sequence[int], size: int, projected: bool, cell: float) -> float:
    """Median |D − D₀| in voxels of size `cell` over the photos; `projected` is `surfels.projected_depth`."""
    flat = replace(surfels, sdf=torch.zeros_like(surfels.sdf), attributes={k: v for k, v in surfels.attributes.items() if k != "opacity"})
    shifts = []
    for index in photos:
        camera = posed.cameras.cameras[index].downscaled_to(size)
        own, none = (SurfelRenderer(s, None).gbuffer(camera, projected) for s in (surfels, flat))
        both = (own["alpha"] > MIN_ALPHA) & (none["alpha"] > MIN_ALPHA)
        shifts.append(np.abs(own["depth"] - none["depth"])[both])
    return float(np.median(np.concatenate(shifts))) / cell


def true_distances(points: NDArray[np.float64], surface: Surface) -> NDArray[np.float64]:
    """Signed distances (n,) of points (n, 3) near a surface, negative behind the nearest face."""
    distance, face = nearest(points, surface, 7)
    offset = points - nearest_on_faces(points, surface.corners[face])
    return np.where((offset * surface.area_normals[face]).sum(1) < 0, -distance, distance)


def correlation(surfels: Surfels, posed: PosedPhotos, surface: Surface) -> float:
    """Pearson's, of the distances of the surfels and the true ones in the unit frame; 0 where all distances are the same."""
    world = posed.cameras.to_world
    true = true_distances(world.apply(surfels.position.numpy().astype(np.float64)), surface) / world.scale
    near = np.abs(true) < MAX_SPACINGS * typical_spacing(surfels)
    own = surfels.sdf.numpy()[near]
    return float(np.corrcoef(own, true[near])[0, 1]) if len(own) > 2 and np.ptp(own) > 0 else 0.0


def measure(capture: str, system: str, seed: int, settings: Sequence[str], out: Path, threads: int) -> list[Row]:
    """Train one system on one capture, stopping at every share. Raises UsageError without the truth or its cameras."""
    options, truth_folder = run_options(capture, system, seed, settings, out, threads)
    session = open_session(options)
    at = {s.name: s.artifact.folder for s in session.engine.run("stereo") if s.artifact is not None}
    p, posed, truth = session.profile.profile, PosedPhotos.open(at["poses"]), read_truth(truth_folder)
    surface = truth.surface
    if posed.cameras.poses != "given":
        frame = camera_frame(read_centres(at["poses"] / "cameras.json"), truth)
        surface = Surface(frame.inverse().apply(surface.vertices), surface.faces)
    scratch = out / "distance"
    shutil.rmtree(scratch, ignore_errors=True)
    (scratch / "out").mkdir(parents=True)
    chosen = np.unique(np.linspace(0, len(posed) - 1, PHOTOS).round().astype(int)).tolist()
    rows = []
    for share in SHARES:
        counts: dict[str, Any] = {}
        try:
            results = train_surfels(
                at["poses"], scratch / "out", training_options(p), stereo=at.get("stereo"), seed=seed, threads=threads, scratch=scratch,
                monitor=StopAt(share),
            )  # fmt: skip
            surfels, counts = Surfels.load(scratch / "out" / "surfels.safetensors"), results["densification"]
        except InterruptedRun:
            body = load_checkpoint(scratch / "checkpoint.safetensors")["trainer"]
            surfels, counts = Surfels.from_tensors(body["surfels"], transfer_by_name(p.surfels.transfer)), body["counts"]
        centres = surfels.position.numpy().astype(np.float64)
        spacing = surfel_spacing(centres)
        footprint = pixel_footprint([c.downscaled_to(p.train.max_size) for c in posed.cameras.cameras], centres.mean(0))
        cell = choose_resolution(float(np.ptp(centres, 0).max()), spacing, footprint, p.mesh.resolution, p.mesh.max_resolution).cell
        rows.append(
            Row(
                capture, system, " ".join(settings), seed, share,
                shift=depth_shift(surfels, posed, chosen, p.train.max_size, p.surfels.projected_depth, cell),
                correlation=correlation(surfels, posed, surface),
                opacity=float(surfels.opacity().median()),
                spacing_cells=spacing / cell,
                surfels=len(surfels),
                counts=" ".join(f"{k}: {v}" for k, v in counts.items()),
                commit=current_commit(), host=platform.node(),
            )
        )  # fmt: skip
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and write."""
    args = parse(arguments, __doc__, ("built-in",), DEFAULT_SYSTEMS, RESULTS)
    for capture in args.captures:
        for system in args.systems:
            for seed in args.seeds:
                try:
                    rows = measure(capture, system, seed, args.settings, args.out.resolve(), args.threads)
                except UsageError as error:
                    sys.exit(f"{capture}: {error}")
                for row in rows:
                    head = f"{row.capture:10} {row.system:8} {row.settings} seed {row.seed} {row.share:4.0%}"
                    figures = f"shift {row.shift:.4f} voxels  correlation {row.correlation:+.3f}  opacity {row.opacity:.4f}"
                    sys.stdout.write(f"{head}  {figures}  {row.surfels} surfels  {row.counts}\n")
                sys.stdout.flush()
                write(args.csv, rows, (*KEY, "share"))


if __name__ == "__main__":
    main()
