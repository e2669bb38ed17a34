"""Reference implementation (NumPy, double precision) of `photometric_kernel` for one point, for tests."""

from __future__ import annotations

import numpy as np

from gsbake.geometry.cameras import Array
from gsbake.meshing.refinement.photometric_kernel import MAX_COST
from gsbake.mvs.ncc_reference import homography, ncc_cost_reference
from gsbake.mvs.pyramids import Photo


def displacement_reference(
    photo: Photo, others: list[Photo], point: Array, normal: Array, step: float, best_of: int
) -> tuple[float, float, float] | None:
    """Displacement along the unit `normal` (3,) of `point` (3,) in world units, second derivative of the summed cost per step², and mean
    cost of the selected views; None where no view matches.

    The patch is centred at the pixel of `photo` nearest to the point, in the plane through the point.
    """
    camera = photo.camera
    (pixel,), _ = camera.project(point[None])
    column, row = np.floor(pixel).astype(int)
    normal_in_camera, depth = camera.R @ normal, float(normal @ (point - camera.centre))
    mask = photo.inside > 0

    def costs(offset: float) -> list[float | None]:
        return [
            ncc_cost_reference(
                photo.grey, mask, (row, column), other.grey, homography(camera, other.camera, normal_in_camera, depth + offset)
            )
            for other in others
        ]

    costs_centre = costs(0.0)
    selected = sorted((c, j) for j, c in enumerate(costs_centre) if c is not None and c < MAX_COST)[:best_of]
    if not selected:
        return None
    sums = []
    for offset in (-step, 0.0, step):
        costs_at = costs(offset)
        selected_costs = [costs_at[j] for _, j in selected]
        if any(c is None for c in selected_costs):
            return None
        sums.append(float(np.sum(np.array(selected_costs, float))))
    curvature = sums[0] + sums[2] - 2 * sums[1]
    if curvature <= 0:
        return None
    return 0.5 * (sums[0] - sums[2]) / curvature * step, curvature, sums[1] / len(selected)
