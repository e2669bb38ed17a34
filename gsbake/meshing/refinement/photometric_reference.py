"""The displacement of one point written for reading, in NumPy and double precision: what `photometric_kernel` is tested against."""

from __future__ import annotations

import numpy as np

from gsbake.geometry.cameras import Array
from gsbake.meshing.refinement.photometric_kernel import WORST
from gsbake.mvs.ncc_reference import cost, homography
from gsbake.mvs.pyramids import Photo


def displacement(
    photo: Photo, others: list[Photo], point: Array, normal: Array, step: float, best_of: int
) -> tuple[float, float, float] | None:
    """Shift along the unit `normal` (3,) of `point` (3,) in world units, second derivative of the summed cost per step², and mean cost of
    the views taken; None where nothing can be said.

    The patch is that of the pixel of `photo` nearest to the point, in the plane through the point.
    """
    camera = photo.camera
    (place,), _ = camera.project(point[None])
    column, row = np.floor(place).astype(int)
    turned, depth = camera.R @ normal, float(normal @ (point - camera.centre))

    def costs(moved: float) -> list[float | None]:
        return [
            cost(photo.grey, photo.inside > 0, (row, column), other.grey, homography(camera, other.camera, turned, depth + moved))
            for other in others
        ]

    middle = costs(0.0)
    taken = sorted((c, j) for j, c in enumerate(middle) if c is not None and c < WORST)[:best_of]
    if not taken:
        return None
    sums = []
    for moved in (-step, 0.0, step):
        found = costs(moved)
        chosen = [found[j] for _, j in taken]
        if any(c is None for c in chosen):
            return None
        sums.append(float(np.sum(np.array(chosen, float))))
    bend = sums[0] + sums[2] - 2 * sums[1]
    if bend <= 0:
        return None
    return 0.5 * (sums[0] - sums[2]) / bend * step, bend, sums[1] / len(taken)
