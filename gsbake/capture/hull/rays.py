"""Rays of photos through the hull's grid: projection of points inside compiled kernels, and cameras and images as arrays for these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera


@nb.njit(fastmath=False, error_model="numpy", nogil=True, cache=True)
def project_point(x: float, y: float, z: float, p: Any, intrinsics: Any, size: Any) -> tuple[int, int, float]:
    """Column, row and z-depth of a point in a photo (arrays of `camera_arrays`); depth 0 behind the camera or outside the frame."""
    here = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
    if not here > 1e-6:
        return 0, 0, 0.0
    across = intrinsics[0] * (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / here + intrinsics[2]
    down = intrinsics[1] * (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / here + intrinsics[3]
    if not (across >= 0 and down >= 0 and across < size[0] and down < size[1]):
        return 0, 0, 0.0
    return int(across), int(down), here


@nb.njit(fastmath=False, error_model="numpy", nogil=True, cache=True)
def half_steps_inside(solid: Any, i: float, j: float, k: float, dx: float, dy: float, dz: float, most: int) -> int:
    """Half-cell steps of a ray inside the cells `solid` (n, n, n), counted from the point (i, j, k), in cells, in both directions of the
    vector (dx, dy, dz); stops at `most`. The point itself does not count."""
    n0, n1, n2 = solid.shape
    length = 0.5 / np.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * length, dy * length, dz * length
    count = 0
    for _ in range(2):
        a, b, c = i + dx, j + dy, k + dz
        while count < most and a >= 0 and b >= 0 and c >= 0 and a < n0 and b < n1 and c < n2:
            count += solid[np.int64(a), np.int64(b), np.int64(c)]
            a, b, c = a + dx, b + dy, c + dz
        dx, dy, dz = -dx, -dy, -dz
    return count


@nb.njit(fastmath=False, error_model="numpy", nogil=True, cache=True)
def trilinear(field: Any, x: Any, y: Any, z: Any) -> Any:
    """Value of a `field` (n0, n1, n2) at lattice coordinates; 1000 beyond the grid."""
    n0, n1, n2 = field.shape
    if not (x >= 0 and y >= 0 and z >= 0 and x < n0 - 1 and y < n1 - 1 and z < n2 - 1):
        return np.float32(1e3)
    i, j, k = int(x), int(y), int(z)
    a, b, c = np.float32(x - i), np.float32(y - j), np.float32(z - k)
    one = np.float32(1)
    p = (field[i, j, k] * (one - c) + field[i, j, k + 1] * c) * (one - b) + (
        field[i, j + 1, k] * (one - c) + field[i, j + 1, k + 1] * c
    ) * b
    q = (field[i + 1, j, k] * (one - c) + field[i + 1, j, k + 1] * c) * (one - b)
    q += (field[i + 1, j + 1, k] * (one - c) + field[i + 1, j + 1, k + 1] * c) * b
    return p * (one - a) + q * a


def camera_arrays(cameras: Sequence[Camera]) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Sizes (v, 2) as width, height, intrinsics (v, 4) as fx, fy, cx, cy, poses (v, 3, 4), world → camera, and centres (v, 3)."""
    sizes = np.array([(c.width, c.height) for c in cameras], np.int64).reshape(-1, 2)
    intrinsics = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], float).reshape(-1, 4)
    poses = np.array([np.concatenate([c.R, c.t[:, None]], 1) for c in cameras], float).reshape(-1, 3, 4)
    return sizes, intrinsics, poses, np.array([c.centre for c in cameras], float).reshape(-1, 3)


def concatenate_images(images: Sequence[NDArray[np.float32]]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The pixels of all images (h, w) one after the other, and where each image starts (v,)."""
    starts = np.concatenate([[0], np.cumsum([image.size for image in images])[:-1]]).astype(np.int64)
    return np.concatenate([np.asarray(image, np.float32).ravel() for image in images]), starts
