"""Captures from their photos alone: how many are registered, how well the automatic masks agree with those made by hand, and what it costs.

python -m benchmarks.photos [CAPTURE …] [--profile preview] [--out DIR] [--csv FILE]

CAPTURE is the name of a folder in $GSBAKE_CAPTURES, else ../shared/captures. Its photos are copied without masks and poses, then
`gsbake poses` runs on them. `overlap` is the intersection over union of the masks in use with those in CAPTURE/masks, where these exist
(`benchmarks.masks`); `left_out` is the largest share, over four groups of photos, of the silhouettes that the visual hull of all photos
leaves out (`benchmarks.rigidity`). CPU seconds are those of both stages. Rows of other captures in the CSV stay.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures import measure_captures
from benchmarks.csv_rows import current_commit, today
from benchmarks.masks import compare
from benchmarks.rigidity import shares
from benchmarks.skip import CpuClock
from benchmarks.timeline import CAPTURES, ROOT, manifests
from gsbake.api import RunOptions, open_session
from gsbake.capture.hull.visual_hull import read_masks
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.sources import PHOTO_FOLDERS, list_photos
from gsbake.errors import UsageError
from gsbake.pipeline.machine import cpu_name

RESULTS = ROOT / "benchmarks" / "results" / "photos.csv"
NAMES = ("kermit", "banana", "axe", "mary_rose")
#: Groups of photos whose silhouettes are compared with the hull of all.
GROUPS = 4


@dataclass(frozen=True)
class Row:
    """One capture; None where there is no such figure (no masks in use, or none made by hand)."""

    capture: str
    profile: str
    photos: int
    registered: int
    reprojection_px: float
    agreement: float | None
    masks: int
    overlap_median: float | None
    overlap_worst: float | None
    left_out_pct: float | None
    cpu_s: float
    commit: str
    host: str
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one capture and profile replace each other."""
        return self.capture, self.profile


def photos_alone(capture: Path, folder: Path) -> Path:
    """A folder with copies of the photos of `capture`, without masks and poses. Raises UsageError where there are none."""
    source = next((capture / name for name in PHOTO_FOLDERS if (capture / name).is_dir()), None)
    if source is None:
        raise UsageError(f"{capture} has no folder of photos ({', '.join(PHOTO_FOLDERS)}).")
    folder.mkdir(parents=True, exist_ok=True)
    for path in list_photos(source):
        if not (folder / path.name).exists():
            shutil.copyfile(path, folder / path.name)
    return folder


def left_out_pct(poses: Path, groups: int = GROUPS) -> float:
    """Percent of the silhouettes that the hull of all photos leaves out: the median of each group of photos, and of these the largest."""
    cameras, masks = read_masks(PosedPhotos.open(poses))
    order = sorted(range(len(cameras)), key=lambda i: cameras[i].name)
    found = shares([cameras[i] for i in order], [masks[i] for i in order], range(len(order)), range(len(order)))
    return 100 * max(float(np.median(part)) for part in np.array_split(found, groups))


def measure(capture: Path, profile: str, out: Path) -> Row:
    """Run `gsbake poses` on the photos alone in `out` and compare. Raises what the stages raise."""
    photos = photos_alone(capture, out / "photos")
    clock = CpuClock(out / "cpu.json")
    states = open_session(RunOptions(photos=photos, out=out / "run", profile=profile, device="cpu"), clock).engine.run("poses")
    results: dict[str, Any] = manifests(states)["poses"]["results"]
    folders = {s.name: s.artifact.folder for s in states if s.artifact is not None}
    masks = int(results.get("automatic_masks", 0))
    overlaps: list[float] = []
    if masks and (capture / "masks").is_dir():
        overlaps = list(compare(folders["ingest"], folders["poses"], capture / "masks")["in use"].values())
    return Row(
        capture.name,
        profile,
        len(list_photos(photos)),
        int(results["registered"]),
        round(float(results["reprojection_px"]), 3),
        _rounded(results.get("mask_agreement")),
        masks,
        _rounded(float(np.median(overlaps)) if overlaps else None),
        _rounded(float(min(overlaps)) if overlaps else None),
        _rounded(left_out_pct(folders["poses"]) if masks else None),
        round(clock.total(states), 1),
        current_commit(),
        cpu_name(),
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the captures, writing a row after each."""
    def run(name: str, profile: str, out: Path) -> Row:
        return measure(CAPTURES / name, profile, out / f"{name}-{profile}")

    measure_captures(__doc__, NAMES, RESULTS, Row, run, arguments)


if __name__ == "__main__":
    main()
