"""Alignment of small patches between photos to a fraction of a pixel.

A patch of one photo is found again in another by Gauss-Newton in the inverse compositional form (Baker & Matthews, *Lucas-Kanade 20 years
on*, IJCV 2004): the warp is affine, gain and offset of the brightness are eliminated, pixels are weighted by a Gaussian. The affine part
matters: shifts alone are no better than SIFT's positions where the patch's plane is known only roughly.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Pixels from the centre of a patch to its edge, and standard deviation of the weights in pixels.
HALF, SIGMA = 10, 5.0
#: Edge of a patch with the border that its gradients need.
EDGE = 2 * HALF + 3
#: Steps at most, the step in pixels below which none follows, and the longest one.
MAX_STEPS, LAST_STEP, LONGEST_STEP = 20, 0.005, 1.0
#: Sums may be taken in any order; the order is that of the compiled code, not of the threads.
_FASTMATH = {"reassoc", "contract"}
_FLAGS: Any = {"error_model": "numpy", "cache": True, "fastmath": _FASTMATH}


@nb.njit(**_FLAGS)
def _bilinear(photo: Any, x: float, y: float) -> float:
    """Brightness at column `x` and row `y`, pixel centres at integers."""
    column, row = int(x), int(y)
    right, down = x - column, y - row
    upper = photo[row, column] + right * (photo[row, column + 1] - photo[row, column])
    lower = photo[row + 1, column] + right * (photo[row + 1, column + 1] - photo[row + 1, column])
    return upper + down * (lower - upper)


@nb.njit(**_FLAGS)
def _solve(matrix: Any, vector: Any) -> None:
    """Solve in place: `vector` becomes the solution; `matrix` (n, n), symmetric and positive, becomes its Cholesky factor."""
    n = len(vector)
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(max(rest, 1e-12)) if i == j else rest / matrix[j, j]
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]


@kernel("i8, i8, f4[:, ::1], f8[:, ::1], f4[:, :, ::1], b1[::1]", nogil=True, error_model="numpy", fastmath=_FASTMATH)
def _cut(lo: int, hi: int, photo: Any, centres: Any, patches: Any, inside: Any) -> None:
    """Kernel of `cut_patches`."""
    height, width = photo.shape
    reach = EDGE // 2
    for k in range(lo, hi):
        x, y = centres[k, 0] - 0.5, centres[k, 1] - 0.5
        inside[k] = x - reach >= 0 and y - reach >= 0 and x + reach < width - 1 and y + reach < height - 1
        if inside[k]:
            for row in range(EDGE):
                for column in range(EDGE):
                    patches[k, row, column] = _bilinear(photo, x + column - reach, y + row - reach)


@kernel(
    "i8, i8, f4[:, ::1], f4[:, :, ::1], i8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1]", nogil=True, error_model="numpy", fastmath=_FASTMATH
)
def _align(lo: int, hi: int, photo: Any, patches: Any, index: Any, start: Any, affine: Any, found: Any) -> None:
    """Kernel of `align_patches`."""
    height, width = photo.shape
    edge = 2 * HALF + 1
    count = edge * edge
    weight, target, value, slope = np.empty(count), np.empty(count), np.empty(count), np.empty((count, 6))
    normal, factor, step = np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    total = 0.0
    for k in range(count):
        weight[k] = np.exp(-((k // edge - HALF) ** 2 + (k % edge - HALF) ** 2) / (2 * SIGMA * SIGMA))
        total += weight[k]
    for item in range(lo, hi):
        patch = patches[index[item]]
        mean = 0.0
        for k in range(count):
            row, column = k // edge + 1, k % edge + 1
            target[k] = patch[row, column]
            mean += weight[k] * target[k]
            along, down = 0.5 * (patch[row, column + 1] - patch[row, column - 1]), 0.5 * (patch[row + 1, column] - patch[row - 1, column])
            u, v = column - 1 - HALF, row - 1 - HALF
            slope[k, 0], slope[k, 1], slope[k, 2] = along, down, along * u
            slope[k, 3], slope[k, 4], slope[k, 5] = along * v, down * u, down * v
        mean /= total
        energy = 0.0
        for k in range(count):
            target[k] -= mean
            energy += weight[k] * target[k] ** 2
        found[item, 0], found[item, 1], found[item, 2] = start[item, 0], start[item, 1], -1.0
        if energy < 1e-3 * total:
            continue
        for p in range(6):  # what gain and offset explain is taken from the slopes
            offset, gain = 0.0, 0.0
            for k in range(count):
                offset += weight[k] * slope[k, p]
                gain += weight[k] * slope[k, p] * target[k]
            for k in range(count):
                slope[k, p] -= offset / total + gain / energy * target[k]
        for p in range(6):
            for q in range(p + 1):
                normal[p, q] = 0.0
                for k in range(count):
                    normal[p, q] += weight[k] * slope[k, p] * slope[k, q]
            normal[p, p] *= 1 + 1e-6
        x, y = start[item, 0] - 0.5, start[item, 1] - 0.5
        a, b, c, d = affine[item, 0, 0], affine[item, 0, 1], affine[item, 1, 0], affine[item, 1, 1]
        for _ in range(MAX_STEPS):
            found[item, 2] = -1.0
            across, high = HALF * (abs(a) + abs(b)), HALF * (abs(c) + abs(d))
            if not (x - across >= 0 and y - high >= 0 and x + across < width - 1 and y + high < height - 1):
                break
            mean = 0.0
            for k in range(count):
                u, v = k % edge - HALF, k // edge - HALF
                value[k] = _bilinear(photo, x + a * u + b * v, y + c * u + d * v)
                mean += weight[k] * value[k]
            mean /= total
            square, product = 0.0, 0.0
            for k in range(count):
                value[k] -= mean
                square += weight[k] * value[k] ** 2
                product += weight[k] * value[k] * target[k]
            if not product > 0:
                break
            found[item, 2] = product / np.sqrt(square * energy)
            gain = np.sqrt(energy / square)
            for p in range(6):
                step[p] = 0.0
                for k in range(count):
                    step[p] += weight[k] * slope[k, p] * (gain * value[k] - target[k])
            factor[:] = normal
            _solve(factor, step)
            length = np.sqrt(step[0] ** 2 + step[1] ** 2)
            shrink = min(1.0, LONGEST_STEP / max(length, 1e-12))
            # The warp is followed by the inverse of the patch's own: u -> (1 + s) u + t.
            s00, s01, s10, s11 = 1 + step[2], step[3], step[4], 1 + step[5]
            area = s00 * s11 - s01 * s10
            if not 0.2 < area < 5:
                found[item, 2] = -1.0
                break
            i00, i01, i10, i11 = s11 / area, -s01 / area, -s10 / area, s00 / area
            a, b, c, d = a * i00 + b * i10, a * i01 + b * i11, c * i00 + d * i10, c * i01 + d * i11
            x -= shrink * (a * step[0] + b * step[1])
            y -= shrink * (c * step[0] + d * step[1])
            if length < LAST_STEP:
                break
        found[item, 0], found[item, 1] = x + 0.5, y + 0.5


def cut_patches(photo: Floats, centres: Doubles) -> tuple[Floats, NDArray[np.bool_]]:
    """Patches (n, EDGE, EDGE) of a grey `photo` (h, w) around `centres` (n, 2), pixel centres at + .5, and which lie in it wholly (n,)."""
    patches, inside = np.zeros((len(centres), EDGE, EDGE), np.float32), np.zeros(len(centres), np.bool_)
    run_chunks(lambda lo, hi: _cut(lo, hi, photo, centres, patches, inside), len(centres), minimum=64)
    return patches, inside


def align_patches(photo: Floats, patches: Floats, index: NDArray[np.int64], start: Doubles, affine: Doubles) -> tuple[Doubles, Doubles]:
    """Where patches lie in a grey `photo` (h, w), and how well they fit there.

    `index` (n,) into the `patches` of `cut_patches`; `start` (n, 2): first guess of the centres, pixel centres at + .5; `affine` (n, 2, 2):
    first guess of the photo's pixels per pixel of the patch. Returns the centres (n, 2) and the correlation (n,) of the brightness, -1
    where the patch has no contrast or leaves the photo.
    """
    found = np.empty((len(index), 3))
    run_chunks(lambda lo, hi: _align(lo, hi, photo, patches, index, start, affine, found), len(index), minimum=16)
    return found[:, :2], found[:, 2]
