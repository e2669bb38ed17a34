"""Distance between neighbouring surfels: from their positions, or from their scales."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.surfels.model import SCALE_TO_SPACING, Surfels


def surfel_spacing(positions: NDArray[np.floating], limit: int = 20_000) -> float:
    """Median spacing of neighbouring surfels on a surface.

    n neighbours within radius r at spacing s (one per s²) give n s² = π r²; n = 4 gives s = r √(π/4).
    """
    points = np.asarray(positions, np.float64)
    if len(points) < 6:
        return float("inf")
    sample = points[:: max(1, len(points) // limit)]
    radius = cKDTree(points).query(sample, k=[5])[0][:, 0]  # the first neighbour is the point itself
    return float(np.median(radius) * np.sqrt(np.pi / 4))


def typical_spacing(surfels: Surfels) -> float:
    """Typical distance (unit frame) between neighbouring surfels, from their median scale; 1 without surfels."""
    return float(surfels.scale.detach().max(1).values.median()) / SCALE_TO_SPACING if len(surfels) else 1.0
