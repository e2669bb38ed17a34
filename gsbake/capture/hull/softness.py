"""Which parts of a visual hull's surface the silhouettes determine.

Laurentini (*How far 3D shapes can be understood from 2D silhouettes*, PAMI 1995) calls a point of the hull hard when every object with
these silhouettes has it on its surface, and soft when there may be air. A ray along the edge of a silhouette touches the object somewhere
on its chord through the hull. Where the chord is short, as on a ball, the object is there. A long chord is a lid over a hollow, a wedge
between two parts, a side that no photo sees along, or a flat face: the surface may lie deeper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.rays import camera_arrays, concatenate_images, half_steps_inside, project_point
from gsbake.capture.hull.visual_hull import MAX_INCONSISTENT_SHARE, Hull, silhouette_distance
from gsbake.capture.photos.decode import Bytes
from gsbake.geometry.cameras import Camera
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

Floats = NDArray[np.float32]

#: Softness from which a part is called soft, otherwise hard; the chord of a ball has 1.
SOFT = 1.1
#: A ray runs along the edge of a silhouette when it passes at most this far inside, in cells; depth below a ball's surface at which its
#: chord is taken for comparison; greatest chord in cells; smoothing over the surface in cells.
EDGE_BAND, BALL_DEPTH, LONGEST_CHORD, SMOOTHING = 1.5, 0.75, 200, 1.0


@kernel(
    "i8, i8, i8[:, ::1], b1[:, :, ::1], f8[::1], f8, f4[::1], i8[::1], i8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8, f8, i8, "
    "f4[::1]",
    nogil=True, error_model="numpy",
)
def _shortest_chords(
    lo: int, hi: int, cells: Any, solid: Any, lower: Any, cell: float, distance: Any, starts: Any, sizes: Any, intrinsics: Any, poses: Any,
    centres: Any, ranks: int, band: float, longest: int, out: Any,
) -> None:  # fmt: skip
    """Kernel of `shortest_chords` for the cells lo..hi; `distance` are the concatenated silhouette distances in pixels, the photo `v` from
    `starts[v]` on."""
    shortest = np.empty(ranks, np.int64)
    for m in range(lo, hi):
        shortest[:] = 2 * longest
        i, j, k = cells[m, 0] + 0.5, cells[m, 1] + 0.5, cells[m, 2] + 0.5
        x, y, z = lower[0] + i * cell, lower[1] + j * cell, lower[2] + k * cell
        for v in range(poses.shape[0]):
            column, row, here = project_point(x, y, z, poses[v], intrinsics[v], sizes[v])
            if not here > 0 or distance[starts[v] + row * sizes[v, 0] + column] * here / intrinsics[v, 0] < -band * cell:
                continue
            towards = x - centres[v, 0], y - centres[v, 1], z - centres[v, 2]
            steps = 1 + half_steps_inside(solid, i, j, k, towards[0], towards[1], towards[2], shortest[ranks - 1])
            slot = ranks - 1
            if steps < shortest[slot]:
                while slot > 0 and shortest[slot - 1] > steps:
                    shortest[slot] = shortest[slot - 1]
                    slot -= 1
                shortest[slot] = steps
        out[m] = 0.5 * shortest[ranks - 1]


def shortest_chords(cells: NDArray[np.int64], hull: Hull, cameras: Sequence[Camera], masks: Sequence[Bytes]) -> Floats:
    """Shortest chord (m,) through the hull, in cells, of the rays through `cells` (m, 3) that run along the edge of a silhouette.

    `cameras` are pinholes of the masks' sizes. As many photos as the hull lets be wrong are passed over. At most LONGEST_CHORD, which cells
    without such a ray have too.
    """
    ranks = 1 + int(MAX_INCONSISTENT_SHARE * len(masks) + 0.5)
    out = np.empty(len(cells), np.float32)
    args = (
        np.ascontiguousarray(cells), hull.field < 0, np.asarray(hull.lower, float), float(hull.cell),
        *concatenate_images([silhouette_distance(mask) for mask in masks]), *camera_arrays(cameras), ranks, EDGE_BAND, LONGEST_CHORD, out,
    )  # fmt: skip
    run_chunks(lambda lo, hi: _shortest_chords(lo, hi, *args), len(cells))
    return out


def surface_softness(hull: Hull, cameras: Sequence[Camera], masks: Sequence[Bytes]) -> Floats:
    """Softness (n, n, n) of the hull's surface; other cells have that of the nearest one on the surface. The hull is not empty.

    It is the shortest chord, averaged over neighbours, over √(8 r BALL_DEPTH): the chord of a ball of the hull's mean radius
    r = 3 volume / area, in cells, at the depth of BALL_DEPTH cells.
    """
    solid = hull.field < 0
    surface = solid & ~ndimage.binary_erosion(solid)
    cells = np.argwhere(surface)
    logarithm = np.zeros(solid.shape, np.float32)
    logarithm[surface] = np.log(shortest_chords(cells, hull, cameras, masks))
    weight = ndimage.gaussian_filter(surface.astype(np.float32), SMOOTHING)
    mean = np.exp(ndimage.gaussian_filter(logarithm, SMOOTHING)[surface] / weight[surface])
    radius = 3.0 * np.count_nonzero(solid) / len(cells)
    out = np.zeros(solid.shape, np.float32)
    out[surface] = mean / np.sqrt(8.0 * radius * BALL_DEPTH)
    nearest = ndimage.distance_transform_edt(~surface, return_distances=False, return_indices=True)
    return np.asarray(out[tuple(nearest)])
