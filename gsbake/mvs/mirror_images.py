"""Depths of mirror images: they lie behind a part of the visual hull where silhouettes say that the surface is.

A specular surface shows its surroundings at a place behind itself, and stereo matches them there. Where the hull's surface is hard
(`gsbake.capture.hull.softness`) the object is at it, and a depth farther behind cannot be the object's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.rays import camera_arrays
from gsbake.capture.hull.softness import SOFT
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.mvs.depth_maps import DepthMap

Floats = NDArray[np.float32]

#: Cells below the hull's surface from which a depth is a mirror image, and cells around a soft part that count as soft: a ray may enter a
#: hollow beside the edge of its opening.
MIN_DEPTH, SOFT_BORDER = 2.0, 4


@nb.njit(error_model="numpy", cache=True)
def _cell_at(origin: Any, ray: Any, depth: float, cell: float) -> Any:
    """Cell (i, j, k) of a ray from `origin`, relative to the grid's corner, at a depth."""
    return (
        np.int64(np.floor((origin[0] + depth * ray[0]) / cell)),
        np.int64(np.floor((origin[1] + depth * ray[1]) / cell)),
        np.int64(np.floor((origin[2] + depth * ray[2]) / cell)),
    )


@kernel(
    "i8, i8, f4[:, ::1], f8[::1], f8[:, ::1], f8[::1], f4[:, :, ::1], b1[:, :, ::1], f8[::1], f8, f8, b1[:, ::1]",
    nogil=True, error_model="numpy",
)
def _behind_hard(
    lo: int, hi: int, depth: Any, intrinsics: Any, pose: Any, centre: Any, field: Any, hard: Any, lower: Any, cell: float, deepest: float,
    out: Any,
) -> None:  # fmt: skip
    """Kernel of `behind_hard_parts` for the rows lo..hi of one photo; `deepest` is the signed distance from which a depth counts."""
    n = field.shape[0]
    origin = centre - lower
    ray = np.empty(3)
    for v in range(lo, hi):
        for u in range(depth.shape[1]):
            there = depth[v, u]
            if not there > 0:
                continue
            a, b = (u + 0.5 - intrinsics[2]) / intrinsics[0], (v + 0.5 - intrinsics[3]) / intrinsics[1]
            first = 0.0
            for axis in range(3):  # the ray per unit of depth, and its depth where it enters the grid
                ray[axis] = pose[0, axis] * a + pose[1, axis] * b + pose[2, axis]
                if abs(ray[axis]) > 1e-9:
                    first = max(first, min(-origin[axis] / ray[axis], (n * cell - origin[axis]) / ray[axis]))
            i, j, k = _cell_at(origin, ray, there, cell)
            if not (0 <= i < n and 0 <= j < n and 0 <= k < n and field[i, j, k] < deepest):
                continue
            step, here = 0.5 * cell / np.sqrt(a * a + b * b + 1.0), first + 1e-6
            while here < there:
                i, j, k = _cell_at(origin, ray, here, cell)
                if 0 <= i < n and 0 <= j < n and 0 <= k < n and field[i, j, k] < 0:
                    out[v, u] = hard[i, j, k]
                    break
                here += step


def behind_hard_parts(hull: Hull, softness: Floats, cameras: Sequence[Camera], depths: Iterable[Floats]) -> Iterator[NDArray[np.bool_]]:
    """Which z-depths (h, w; 0 = none) of the `cameras` lie MIN_DEPTH cells or more below the hull's surface, on rays that enter the hull
    through a hard part, one by one.

    `softness` (n, n, n) as from `surface_softness`.
    """
    hard = ndimage.maximum_filter(softness, 2 * SOFT_BORDER + 1) < SOFT
    lower, cell = np.asarray(hull.lower, float), float(hull.cell)
    for depth, *camera in zip((np.asarray(d, np.float32) for d in depths), *camera_arrays(cameras)[1:], strict=True):
        out = np.zeros(depth.shape, np.bool_)
        args = (depth, *camera, hull.field, hard, lower, cell, -MIN_DEPTH * cell, out)
        run_chunks(lambda lo, hi, args=args: _behind_hard(lo, hi, *args), len(depth))  # type: ignore[misc]
        yield out


def without_mirror_images(maps: Sequence[DepthMap], hull: Hull, softness: Floats) -> tuple[list[DepthMap], float]:
    """The depth maps without depths behind hard parts, and the share of the depths that these were."""
    behind = behind_hard_parts(hull, softness, [one.camera for one in maps], (one.depth() for one in maps))
    kept = [one.select(~mirrored.ravel()[one.pixels]) for one, mirrored in zip(maps, behind, strict=True)]
    depths = sum(map(len, maps))
    return kept, (depths - sum(map(len, kept))) / max(depths, 1)
