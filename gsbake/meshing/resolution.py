"""How fine the field must be: from what the surfels and the photos can resolve, never from a guess.

A depth map of surfels shows nothing smaller than the surfels' spacing; a photo shows nothing smaller than its pixels' footprint on
the object. A few samples per surfel spacing, no finer than most of a pixel, is all there is to gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.geometry.cameras import Camera

#: Samples per surfel spacing. Surfels overlap, so what they render is smooth at their spacing: more samples only cost (measured: 64, 97
#: and 140 cells on one trained model differ by less than 0.05 % of the object in distance).
PER_SPACING = 1.5
#: A sample is at least this share of a pixel's footprint: views overlap, so fusion resolves a little below the pixel.
FOOTPRINT_SHARE = 0.75
#: Fewer cells than this lose the object's shape, however coarse the evidence.
MIN_CELLS = 48


@dataclass(frozen=True)
class Resolution:
    """The chosen `cell` (unit frame), `cells` along the longest side, and the sentence that says why."""

    cell: float
    cells: int
    reason: str


def surfel_spacing(positions: NDArray[np.floating], limit: int = 20_000) -> float:
    """Median spacing of neighbouring surfels, as if they lay on an even layer.

    n neighbours within radius r on a surface of spacing s (one per s²) means n s² = π r²; with n = 4 that is s = r √(π/4).
    """
    points = np.asarray(positions, np.float64)
    if len(points) < 6:
        return float("inf")
    sample = points[:: max(1, len(points) // limit)]
    radius = cKDTree(points).query(sample, k=[5])[0][:, 0]  # the first neighbour is the point itself
    return float(np.median(radius) * np.sqrt(np.pi / 4))


def pixel_footprint(cameras: Sequence[Camera], centre: NDArray[np.float64]) -> float:
    """Median size of a pixel (world units) at `centre` (3,) over the cameras that look towards it."""
    sizes = []
    for camera in cameras:
        depth = float(camera.R[2] @ centre + camera.t[2])
        if depth > 0:
            sizes.append(depth / np.sqrt(camera.fx * camera.fy))
    return float(np.median(sizes)) if sizes else float("inf")


def choose(extent: float, spacing: float, footprint: float, fixed: int, upper: int) -> Resolution:
    """The cell for an object `extent` long: `fixed` cells when that is not 0, else derived, at most `upper` cells."""
    if fixed:
        return Resolution(extent / fixed, fixed, f"{fixed} cells asked for by the profile")
    by_surfels, by_pixels = spacing / PER_SPACING, footprint * FOOTPRINT_SHARE
    cell = max(by_surfels, by_pixels)
    why = f"1/{PER_SPACING} of the surfel spacing" if by_surfels >= by_pixels else f"{FOOTPRINT_SHARE} of a pixel's footprint"
    wanted = extent / cell
    cells = int(np.clip(np.ceil(wanted), MIN_CELLS, upper))
    if wanted > upper:
        why += f", bounded to {upper} cells"
    elif wanted < MIN_CELLS:
        why += f", raised to {MIN_CELLS} cells"
    reason = f"{why}: surfel spacing {spacing:.4g}, pixel footprint {footprint:.4g}, object {extent:.3g} long"
    return Resolution(extent / cells, cells, reason)
