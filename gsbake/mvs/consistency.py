"""Which depths other photos confirm, which they contradict, and the mean of those that agree.

A pixel's point is confirmed by a view whose own plane at the point's image gives the same depth there (to a share of it) and leads
back to the pixel (to a pixel or so): Galliani et al. 2015; Schönberger et al., *Pixelwise view selection for unstructured multi-view
stereo* (ECCV 2016). It is contradicted by a view that sees through it: that view's surface lies well behind the point. The planes that
agree are averaged in the pixel's own frame: independent errors fall with the root of their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.mvs.ncc import FAST
from gsbake.mvs.pyramids import relative

Floats = NDArray[np.float32]

#: Agreement: share of the depth, pixels from where the point started, cosine between the normals.
DEPTH_SHARE, PIXELS, COSINE = 0.006, 1.0, 0.64
#: A view sees through a point when its surface lies behind it by more than this share of the depth.
THROUGH = 0.015


@dataclass(frozen=True)
class Agreement:
    """Per pixel (h, w): how many views agree and how many see through, the plane (h, w, 3) averaged over those that agree, and the
    `scatter` of their depths (standard deviation about the photo's own, as a share of the depth)."""

    agreeing: NDArray[np.uint8]
    through: NDArray[np.uint8]
    plane: Floats
    scatter: Floats


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _agree(
    plane: Any, good: Any, lens: Any, others: Any, sizes: Any, lenses: Any, rotations: Any, translations: Any,
    other_planes: Any, other_good: Any, starts: Any, share: Any, pixels: Any, cosine: Any, behind: Any,
    agreeing: Any, through: Any, mean: Any, scatter: Any,
) -> None:  # fmt: skip
    """Kernel of `agreement`: all views one after another in `other_planes` (n, 3) and `other_good` (n,)."""
    height, width = good.shape
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    half, one = np.float32(0.5), np.float32(1)
    for v in range(height):
        y = (np.float32(v) + half - cy) / fy
        for u in range(width):
            agreeing[v, u] = 0
            through[v, u] = 0
            scatter[v, u] = 0
            for k in range(3):
                mean[v, u, k] = plane[v, u, k]
            if good[v, u] == 0:
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
                r, t, l = rotations[j], translations[j], lenses[j]
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
                if other_good[index] == 0:
                    continue
                n0, n1, n2 = other_planes[index, 0], other_planes[index, 1], other_planes[index, 2]
                there = n0 * ax + n1 * ay + n2
                if not there > np.float32(1e-6):
                    continue
                depth = one / there
                if depth > qz * (one + behind):
                    through[v, u] += 1
                    continue
                if not abs(depth - qz) < share * qz:
                    continue
                # Back into the reference, from the other view's surface.
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
                agreeing[v, u] += 1
                sum0 += k0
                sum1 += k1
                sum2 += k2
                total += one
                second += gap * gap
            mean[v, u, 0] = sum0 / total
            mean[v, u, 1] = sum1 / total
            mean[v, u, 2] = sum2 / total
            scatter[v, u] = np.sqrt(second / total)


def agreement(
    camera: Camera, plane: Floats, good: NDArray[np.uint8], others: Sequence[tuple[Camera, Floats, NDArray[np.uint8]]]
) -> Agreement:
    """Ask `others` (camera, planes (h, w, 3), which of them count (h, w)) about the planes of one photo; `good` (h, w) selects pixels.

    The mean plane weighs the photo's own and each that agrees the same; where nobody agrees it is the photo's own.
    """
    shape = good.shape
    out = Agreement(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    cameras = [c for c, _, _ in others]
    pairs = [relative(camera, c) for c in cameras]
    _agree(
        plane,
        good,
        _lens(camera),
        len(others),
        np.array([(c.width, c.height) for c in cameras], np.int64).reshape(-1, 2),
        np.array([_lens(c) for c in cameras], np.float32).reshape(-1, 4),
        np.array([r for r, _ in pairs], np.float32).reshape(-1, 3, 3),
        np.array([t for _, t in pairs], np.float32).reshape(-1, 3),
        np.concatenate([p.reshape(-1, 3) for _, p, _ in others]) if others else np.zeros((0, 3), np.float32),
        np.concatenate([g.ravel() for _, _, g in others]) if others else np.zeros(0, np.uint8),
        np.concatenate([[0], np.cumsum([g.size for _, _, g in others])[:-1]]).astype(np.int64) if others else np.zeros(0, np.int64),
        np.float32(DEPTH_SHARE),
        np.float32(PIXELS),
        np.float32(COSINE),
        np.float32(THROUGH),
        out.agreeing,
        out.through,
        out.plane,
        out.scatter,
    )
    return out


def _lens(camera: Camera) -> Floats:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
