"""Accuracy of stereo's points, and of the visual hull before and after carving, on captures with ground truth.

python -m benchmarks.stereo [CAPTURE …] [--profile preview] [--out DIR] [--csv FILE]

CAPTURE is the name of a folder in $GSBAKE_CAPTURES, else ../shared/captures, all photos with masks. Points are compared with the nearest
of the true surface, in % of the true diagonal, after an alignment by cameras and the points themselves where poses were solved; the
normal's error is the median angle to the nearest face. The hulls' figures are those of `benchmarks.hull`. CPU seconds are the stage's.
Rows of other captures in the CSV stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.captures import measure_captures
from benchmarks.csv_rows import current_commit, today
from benchmarks.hull import measure_folders
from benchmarks.skip import CpuClock
from benchmarks.timeline import ROOT, find_capture, manifests
from benchmarks.truth import ALIGNMENT_POINTS, align_points, nearest, read_centres, read_truth
from gsbake.api import RunOptions, open_session
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import UsageError
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.pipeline.machine import cpu_name

RESULTS = ROOT / "benchmarks" / "results" / "stereo.csv"
NAMES = ("boombox", "avocado")


@dataclass(frozen=True)
class Row:
    """One capture: share of the object's pixels with a confirmed depth in %, distances of the points and hulls in % of the true diagonal,
    median angle of the points' normals in degrees."""

    capture: str
    profile: str
    confirmed_pct: float
    points: int
    mean_pct: float
    median_pct: float
    p95_pct: float
    normal_deg: float
    hull_pct: float
    carved_pct: float
    cpu_s: float
    commit: str
    host: str
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one capture and profile replace each other."""
        return self.capture, self.profile


def point_errors(poses: Path, stereo: Path, capture: Path) -> tuple[np.ndarray, np.ndarray]:
    """Distance of every point to the true surface in % of its diagonal (n,), and the angle between the normals in degrees (n,)."""
    posed, truth = PosedPhotos.open(poses), read_truth(capture)
    cloud = StereoCloud.load(stereo / "points.ply")
    frame = posed.cameras.to_world
    if posed.cameras.poses != "given":
        some = np.random.default_rng(0).choice(len(cloud), min(len(cloud), ALIGNMENT_POINTS[0]), replace=False)
        frame = frame.then(align_points(frame.apply(cloud.points[some]), read_centres(poses / "cameras.json"), truth))
    distance, face = nearest(frame.apply(cloud.points), truth.surface, 0)
    cosine = (truth.surface.normals(face) * (cloud.normals @ frame.rotation.T)).sum(1)
    return 100 * distance / truth.surface.diagonal, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def measure(name: str, profile: str, out: Path) -> Row:
    """Run `gsbake stereo` on a capture and compare. Raises what the stages raise, and UsageError without ground truth."""
    capture = find_capture(name, out)
    clock = CpuClock(out / f"{name}-cpu.json")
    options = RunOptions(photos=capture, out=out / f"{name}-{profile}", profile=profile, device="cpu")
    states = open_session(options, clock).engine.run("stereo")
    results = manifests(states)["stereo"]["results"]
    folders = {s.name: s.artifact.folder for s in states if s.artifact is not None}
    if not results["points"]:
        raise UsageError("stereo found no points; photos are too few or too small.")
    distance, angle = point_errors(folders["poses"], folders["stereo"], capture)
    hulls = measure_folders(folders["poses"], folders["stereo"], capture)
    figures = (distance.mean(), np.median(distance), np.quantile(distance, 0.95), np.median(angle))
    shown = [round(float(v), 4) for v in (*figures, hulls.hull.chamfer_pct, hulls.carved.chamfer_pct)]
    spent = round(clock.total([s for s in states if s.name == "stereo"]), 1)
    share = round(100 * float(results["confirmed_share"]), 1)
    return Row(name, profile, share, len(distance), *shown, spent, current_commit(), cpu_name())


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the captures, writing a row after each."""
    measure_captures(__doc__, NAMES, RESULTS, Row, measure, arguments)


if __name__ == "__main__":
    main()
