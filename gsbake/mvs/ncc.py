"""Matching cost of a plane hypothesis at a pixel: 1 − NCC of a patch against its plane-induced warp in another view.

A plane is three numbers m with m·(x, y, 1) = 1/z, where (x, y) are normalised pixels ((u − cx)/fx, (v − cy)/fy) of the reference view; with
unit normal n and distance d (nᵀX = d) it is m = n/d. It maps the reference to view j by the homography K_j (R + t mᵀ) K_r⁻¹ (Hartley &
Zisserman, *Multiple View Geometry*, 13.1). The homography is linearised at the patch centre: over five pixels the neglected term is
quadratic and even, hence no bias.

Patch weights are bilateral (Yoon & Kweon, PAMI 2006) and zero outside the mask. They depend on the reference only, so mean, variance and
weights of a patch are computed once, and a plane costs one bilinear look-up per sample and view. Four 8-bit neighbours share one
32-bit word: one load instead of four.

The kernels reject NaN by guards in the positive form, so the fastmath flags "nnan" and "ninf" stay off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: LLVM fast-math flags of all stereo kernels.
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}
#: Patch radius in pixels.
RADIUS = 9
#: Samples per patch: a whole number of vector registers.
SAMPLES = 32
#: Added to variances (grey levels squared): quantisation to 8 bits and sensor noise.
NOISE_VARIANCE = np.float32(1.5)
#: Cost where the warped patch leaves the source view.
OUT_OF_VIEW_COST = np.float32(2.0)
#: Standard deviations of the bilateral weights: grey levels, and pixels.
SIGMA_GREY, SIGMA_PIXELS = 12.0, 9.0


@dataclass(frozen=True)
class SamplingPattern:
    """Sample offsets `du`, `dv` (s,) of a patch in pixels and bilateral weights: spatial (s,) and by grey difference (256,)."""

    du: Floats
    dv: Floats
    spatial_weight: Floats
    range_weight: Floats

    @property
    def arrays(self) -> tuple[Floats, Floats, Floats, Floats]:
        """The fields as the tuple that kernels take."""
        return self.du, self.dv, self.spatial_weight, self.range_weight

    @staticmethod
    def make() -> SamplingPattern:
        """A sunflower (Vogel 1979) of SAMPLES whole pixels within RADIUS: a patch of 19 x 19 at a tenth of the samples."""
        k = np.arange(SAMPLES) + 0.5
        angle, length = k * math.pi * (3 - math.sqrt(5)), (RADIUS + 0.3) * np.sqrt(k / SAMPLES)
        circle = np.stack([np.cos(angle), np.sin(angle)], 1)
        offsets = (length[:, None] * circle).round().clip(-RADIUS, RADIUS).astype(np.float32)
        spatial_weight = np.exp(-(offsets**2).sum(1) / (2 * SIGMA_PIXELS**2))
        range_weight = np.exp(-(np.arange(256) ** 2) / (2 * SIGMA_GREY**2))
        weights = spatial_weight.astype(np.float32), range_weight.astype(np.float32)
        return SamplingPattern(offsets[:, 0].copy(), offsets[:, 1].copy(), *weights)


def pack_2x2(grey: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Each pixel (h, w) of an 8-bit photo packed with its right, lower and lower right neighbours; the last row and column repeat."""
    wide = np.pad(grey, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    return np.asarray(wide[:-1, :-1] | wide[:-1, 1:] << 8 | wide[1:, :-1] << 16 | wide[1:, 1:] << 24, np.uint32)


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def patch_statistics(grey: Any, inside: Any, v: int, u: int, pattern: Any, weight: Any, moment: Any) -> Any:
    """Fill `weight` (s,), summing to 1, and `moment` (s,) = weight (g − mean)/deviation of the patch at (v, u); return its variance.

    `grey` and `inside` (h + 2 RADIUS, w + 2 RADIUS) are 8-bit with a border; weights are zero where `inside`, the mask, is zero.
    `pattern` is `SamplingPattern.arrays`.
    """
    du, dv, spatial_weight, range_weight = pattern
    here = np.int64(grey[v + RADIUS, u + RADIUS])
    total = np.float32(0)
    mean = np.float32(0)
    for i in range(du.shape[0]):
        y, x = np.uint64(v + RADIUS + np.int64(dv[i])), np.uint64(u + RADIUS + np.int64(du[i]))
        g = np.int64(grey[y, x])
        w = spatial_weight[i] * range_weight[np.uint64(abs(g - here))] * np.float32(inside[y, x])
        weight[i] = w
        moment[i] = np.float32(g)
        total += w
        mean += w * moment[i]
    if not total > np.float32(0):
        weight[:] = 0
        moment[:] = 0
        return np.float32(0)
    scale = np.float32(1) / total
    mean *= scale
    variance = np.float32(0)
    for i in range(du.shape[0]):
        weight[i] *= scale
        gap = moment[i] - mean
        variance += weight[i] * gap * gap
        moment[i] = weight[i] * gap
    inverse = np.float32(1) / np.sqrt(variance + NOISE_VARIANCE)
    for i in range(du.shape[0]):
        moment[i] *= inverse
    return variance


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def ncc_cost(
    j: int, m0: Any, m1: Any, m2: Any, x: Any, y: Any, step_x: Any, step_y: Any, pattern: Any, weight: Any, moment: Any, views: Any,
) -> Any:  # fmt: skip
    """1 − NCC of a patch at normalised (x, y) against source view j under plane m; OUT_OF_VIEW_COST where the patch leaves the view.

    `weight` and `moment` come from `patch_statistics`; `step_x`, `step_y` are 1/fx, 1/fy of the reference; `views` is
    `MatchingViews.sources`: projections (k, 12) with K_j R (row by row) and K_j t, K_j with its principal point less half a pixel;
    packed photos, concatenated; their start offsets (k,); sizes (k, 2) as width, height.
    """
    du, dv = pattern[0], pattern[1]
    projections, packed, starts, sizes = views
    projection = projections[j]
    rho = m0 * x + m1 * y + m2
    e0 = projection[0] * x + projection[1] * y + projection[2] + projection[9] * rho
    e1 = projection[3] * x + projection[4] * y + projection[5] + projection[10] * rho
    e2 = projection[6] * x + projection[7] * y + projection[8] + projection[11] * rho
    if not e2 > np.float32(1e-6):
        return OUT_OF_VIEW_COST
    inverse = np.float32(1) / e2
    u, v = e0 * inverse, e1 * inverse
    gx, gy = projection[6] + projection[11] * m0, projection[7] + projection[11] * m1
    ux = (projection[0] + projection[9] * m0 - u * gx) * inverse * step_x
    uy = (projection[1] + projection[9] * m1 - u * gy) * inverse * step_y
    vx = (projection[3] + projection[10] * m0 - v * gx) * inverse * step_x
    vy = (projection[4] + projection[10] * m1 - v * gy) * inverse * step_y
    reach_u = np.float32(RADIUS) * (abs(ux) + abs(uy))
    reach_v = np.float32(RADIUS) * (abs(vx) + abs(vy))
    width, height = sizes[j, 0], sizes[j, 1]
    if not (u - reach_u >= 0 and v - reach_v >= 0 and u + reach_u < width - 1 and v + reach_v < height - 1):
        return OUT_OF_VIEW_COST
    start = starts[j]
    wide = np.float32(width)
    s0, s1, s2 = np.float32(0), np.float32(0), np.float32(0)
    for i in range(du.shape[0]):
        px = u + ux * du[i] + uy * dv[i]
        py = v + vx * du[i] + vy * dv[i]
        fx, fy = np.float32(np.int32(px)), np.float32(np.int32(py))
        # Exact in single precision up to 16 million pixels.
        word = packed[np.uint64(start + np.int64(np.int32(fy * wide + fx)))]
        a = np.float32(np.int32(word & np.uint32(255)))
        b = np.float32(np.int32((word >> np.uint32(8)) & np.uint32(255)))
        c = np.float32(np.int32((word >> np.uint32(16)) & np.uint32(255)))
        d = np.float32(np.int32(word >> np.uint32(24)))
        px -= fx
        top = a + px * (b - a)
        value = top + (py - fy) * (c + px * (d - c) - top)
        s0 += weight[i] * value
        s1 += weight[i] * value * value
        s2 += moment[i] * value
    variance = max(s1 - s0 * s0, np.float32(0))
    return np.float32(1) - s2 / np.sqrt(variance + NOISE_VARIANCE)
