"""Geometric consistency of depth maps: consistent views and free-space violations per pixel, and the mean of the consistent planes.

A pixel is consistent with a view whose plane at the projected point has the same depth (relative error) and reprojects to the pixel
(error of a pixel or so): Galliani et al. 2015; Schönberger et al., *Pixelwise view selection for unstructured multi-view stereo*
(ECCV 2016). A free-space violation is a view whose surface lies well behind the point. Consistent planes are averaged in the pixel's
camera frame: independent errors fall with the square root of their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.kernels.declaration import kernel
from gsbake.mvs.ncc import FASTMATH
from gsbake.mvs.pyramids import relative_pose

Floats = NDArray[np.float32]

#: Thresholds of consistency: relative depth error, reprojection error in pixels, cosine between the normals.
MAX_DEPTH_ERROR, MAX_REPROJECTION_ERROR, MIN_NORMAL_COSINE = 0.006, 1.0, 0.64
#: A free-space violation: the view's surface lies behind the point by more than this share of the depth.
VIOLATION_MARGIN = 0.015


@dataclass(frozen=True)
class Consistency:
    """Per pixel (h, w): number of `consistent` views and of free-space `violations`, mean `plane` (h, w, 3) of the consistent views, and
    `scatter` of their depths (standard deviation about the photo's own depth, as a share of it)."""

    consistent: NDArray[np.uint8]
    violations: NDArray[np.uint8]
    plane: Floats
    scatter: Floats


@kernel(
    "f4[:, :, ::1], u1[:, ::1], f4[::1], i8, i8[:, ::1], f4[:, ::1], f4[:, :, ::1], f4[:, ::1], f4[:, ::1], u1[::1], i8[::1], f4, f4, f4, "
    "f4, u1[:, ::1], u1[:, ::1], f4[:, :, ::1], f4[:, ::1]",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def _check(
    plane: Any, valid: Any, intrinsics: Any, others: Any, sizes: Any, other_intrinsics: Any, rotations: Any, translations: Any,
    other_planes: Any, other_valid: Any, starts: Any, share: Any, pixels: Any, cosine: Any, violation_margin: Any,
    consistent: Any, violations: Any, mean: Any, scatter: Any,
) -> None:  # fmt: skip
    """Kernel of `check_consistency`: all views concatenated in `other_planes` (n, 3) and `other_valid` (n,)."""
    height, width = valid.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half, one = np.float32(0.5), np.float32(1)
    for v in range(height):
        y = (np.float32(v) + half - cy) / fy
        for u in range(width):
            consistent[v, u] = 0
            violations[v, u] = 0
            scatter[v, u] = 0
            for k in range(3):
                mean[v, u, k] = plane[v, u, k]
            if valid[v, u] == 0:
                continue
            x = (np.float32(u) + half - cx) / fx
            m0, m1, m2 = plane[v, u, 0], plane[v, u, 1], plane[v, u, 2]
            rho = m0 * x + m1 * y + m2
            if not rho > np.float32(1e-6):
                continue
            z = one / rho
            length = np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
            px, py = x * z, y * z
            sum0, sum1, sum2, total, second = m0, m1, m2, one, np.float32(0)
            for j in range(others):
                r, t, l = rotations[j], translations[j], other_intrinsics[j]
                qx = r[0, 0] * px + r[0, 1] * py + r[0, 2] * z + t[0]
                qy = r[1, 0] * px + r[1, 1] * py + r[1, 2] * z + t[1]
                qz = r[2, 0] * px + r[2, 1] * py + r[2, 2] * z + t[2]
                if not qz > np.float32(1e-6):
                    continue
                ax, ay = qx / qz, qy / qz
                pu, pv = l[0] * ax + l[2], l[1] * ay + l[3]
                if not (pu >= 0 and pv >= 0 and pu < sizes[j, 0] and pv < sizes[j, 1]):
                    continue
                index = np.uint64(starts[j] + np.int64(pv) * sizes[j, 0] + np.int64(pu))
                if other_valid[index] == 0:
                    continue
                n0, n1, n2 = other_planes[index, 0], other_planes[index, 1], other_planes[index, 2]
                there = n0 * ax + n1 * ay + n2
                if not there > np.float32(1e-6):
                    continue
                depth = one / there
                if depth > qz * (one + violation_margin):
                    violations[v, u] += 1
                    continue
                if not abs(depth - qz) < share * qz:
                    continue
                # Reproject the other view's surface into the reference.
                bx, by, bz = ax * depth - t[0], ay * depth - t[1], depth - t[2]
                wx = r[0, 0] * bx + r[1, 0] * by + r[2, 0] * bz
                wy = r[0, 1] * bx + r[1, 1] * by + r[2, 1] * bz
                wz = r[0, 2] * bx + r[1, 2] * by + r[2, 2] * bz
                if not wz > np.float32(1e-6):
                    continue
                du, dv = fx * (wx / wz - x), fy * (wy / wz - y)
                if not du * du + dv * dv < pixels * pixels:
                    continue
                # The other plane n·X' = 1 in this frame: n·(R X + t) = 1, so m = Rᵀn / (1 − n·t).
                denominator = one - (n0 * t[0] + n1 * t[1] + n2 * t[2])
                if not abs(denominator) > np.float32(1e-9):
                    continue
                k0 = (r[0, 0] * n0 + r[1, 0] * n1 + r[2, 0] * n2) / denominator
                k1 = (r[0, 1] * n0 + r[1, 1] * n1 + r[2, 1] * n2) / denominator
                k2 = (r[0, 2] * n0 + r[1, 2] * n1 + r[2, 2] * n2) / denominator
                size = np.sqrt(k0 * k0 + k1 * k1 + k2 * k2)
                if not m0 * k0 + m1 * k1 + m2 * k2 > cosine * length * size:
                    continue
                gap = (k0 * x + k1 * y + k2) / rho - one
                if not abs(gap) < np.float32(2) * share:
                    continue
                consistent[v, u] += 1
                sum0 += k0
                sum1 += k1
                sum2 += k2
                total += one
                second += gap * gap
            mean[v, u, 0] = sum0 / total
            mean[v, u, 1] = sum1 / total
            mean[v, u, 2] = sum2 / total
            scatter[v, u] = np.sqrt(second / total)


def check_consistency(
    camera: Camera, plane: Floats, valid: NDArray[np.uint8], others: Sequence[tuple[Camera, Floats, NDArray[np.uint8]]]
) -> Consistency:
    """Check the planes (h, w, 3) of one photo against `others` (camera, planes (h, w, 3), valid (h, w)) where `valid` (h, w).

    The mean weighs the photo's own plane and each consistent one equally; without consistent views it is the photo's own.
    """
    shape = valid.shape
    out = Consistency(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    cameras = [c for c, _, _ in others]
    pairs = [relative_pose(camera, c) for c in cameras]
    _check(
        plane,
        valid,
        _intrinsics(camera),
        len(others),
        np.array([(c.width, c.height) for c in cameras], np.int64).reshape(-1, 2),
        np.array([_intrinsics(c) for c in cameras], np.float32).reshape(-1, 4),
        np.array([r for r, _ in pairs], np.float32).reshape(-1, 3, 3),
        np.array([t for _, t in pairs], np.float32).reshape(-1, 3),
        np.concatenate([p.reshape(-1, 3) for _, p, _ in others]) if others else np.zeros((0, 3), np.float32),
        np.concatenate([g.ravel() for _, _, g in others]) if others else np.zeros(0, np.uint8),
        np.concatenate([[0], np.cumsum([g.size for _, _, g in others])[:-1]]).astype(np.int64) if others else np.zeros(0, np.int64),
        np.float32(MAX_DEPTH_ERROR),
        np.float32(MAX_REPROJECTION_ERROR),
        np.float32(MIN_NORMAL_COSINE),
        np.float32(VIOLATION_MARGIN),
        out.consistent,
        out.violations,
        out.plane,
        out.scatter,
    )
    return out


def _intrinsics(camera: Camera) -> Floats:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
