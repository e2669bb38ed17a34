"""Whether the masks of a capture are those of one rigid object: visual hulls of groups of photos, and that of all.

python -m benchmarks.rigidity RUN [--groups 4] [--without NAME,…]

RUN is the folder of a run whose stage `poses` is finished, all photos with masks. The hull of some photos covers the silhouettes in these
photos as far as masks and poses are right and nothing moves (`gsbake.capture.hull.rigidity`, which warns of it in runs). Photos are taken
in the order of their names, in groups of equal size. A line per group has the share of its silhouettes that the group's own hull leaves
out, and the hull of all photos: median and worst. Where the first is small and the second is not, the object changed between the groups (a
lid, a hinge, cloth), and no rigid asset has all the silhouettes. A cell that one photo excludes is outside: `--without` leaves out photos
whose masks are known to be wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.rigidity import left_out
from gsbake.capture.hull.visual_hull import Hull, read_masks
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import GsbakeError, UsageError
from gsbake.geometry.cameras import Camera
from gsbake.pipeline.store import Store

#: Cells along an edge of the hulls.
RESOLUTION = 192

Bytes = NDArray[np.uint8]


def shares(cameras: Sequence[Camera], masks: Sequence[Bytes], used: Sequence[int], shown: Sequence[int]) -> NDArray[np.float64]:
    """Share of the silhouette in each of the photos `shown` that the visual hull of the photos `used` leaves out."""
    hull = Hull.from_masks([cameras[i] for i in used], [masks[i] for i in used], np.zeros(3), 1.0, RESOLUTION, max_inconsistent_share=0.0)
    return left_out(hull, [cameras[i] for i in shown], [masks[i] for i in shown])


def table(cameras: Sequence[Camera], masks: Sequence[Bytes], groups: int) -> str:
    """A Markdown table with a line per group of photos."""
    everything = range(len(cameras))
    lines = ["| photos | own hull leaves out, median (worst) | hull of all |", "|---|---|---|"]
    of_all = shares(cameras, masks, everything, everything)
    for group in (part.tolist() for part in np.array_split(np.arange(len(cameras)), groups)):
        own, every = shares(cameras, masks, group, group), of_all[group]
        figures = (f"{np.median(found):.2%} ({found.max():.2%})" for found in (own, every))
        lines.append(f"| {cameras[group[0]].name} to {cameras[group[-1]].name} | {' | '.join(figures)} |")
    return "\n".join(lines)


def measure(run: Path, groups: int, without: Sequence[str]) -> str:
    """The table of a run. Raises UsageError when its poses are not finished or photos have no masks."""
    if not (found := Store(run).manifests("poses")):
        raise UsageError(f"{run} has no finished stage poses; run `gsbake poses` first.")
    try:
        cameras, masks = read_masks(PosedPhotos.open(found[0][0]))
    except ValueError as error:
        raise UsageError(f"{run}: {error}; give masks with --masks.") from None
    kept = sorted((i for i, camera in enumerate(cameras) if camera.name not in without), key=lambda i: cameras[i].name)
    if len(kept) < 2 * groups:
        raise UsageError(f"{run} has {len(kept)} photos for {groups} groups; a hull needs two or more.")
    return table([cameras[i] for i in kept], [masks[i] for i in kept], groups)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--groups", type=int, default=4)
    parser.add_argument("--without", type=lambda text: text.split(","), default=[], metavar="NAME,…")
    options = parser.parse_args(arguments)
    try:
        print(measure(options.run, options.groups, options.without))
    except GsbakeError as error:
        print(f"rigidity: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
