"""Numba kernel that samples one view at all texels and stores the sample where the view is among the texel's best.

Samples are stored as 16-bit codes of the square root of the linear value in 0..1: half the memory of floats, about uniform in perception.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel

Floats = NDArray[np.float32]
Codes = NDArray[np.uint16]
Doubles = NDArray[np.float64]

#: Least cosine between a texel's normal and the view.
MIN_COSINE = 0.12


@numba.njit(cache=True, error_model="numpy")
def _sample(image: Floats, x: float, y: float, c: int) -> float:
    """Channel `c` of `image` (h, w, k) at pixel coordinates (x, y): Catmull-Rom, clamped to the range of the nearest four pixels."""
    height, width = image.shape[0], image.shape[1]
    fx, fy = x - 0.5, y - 0.5
    i, j = int(np.floor(fx)), int(np.floor(fy))
    s, t = fx - i, fy - j
    total = 0.0
    low, high = np.inf, -np.inf
    for b in range(-1, 3):
        d = abs(t - b)
        wy = (1.5 * d - 2.5) * d * d + 1 if d < 1 else ((-0.5 * d + 2.5) * d - 4) * d + 2
        row = min(max(j + b, 0), height - 1)
        for a in range(-1, 3):
            d = abs(s - a)
            wx = (1.5 * d - 2.5) * d * d + 1 if d < 1 else ((-0.5 * d + 2.5) * d - 4) * d + 2
            value = image[row, min(max(i + a, 0), width - 1), c]
            total += wx * wy * value
            if 0 <= a <= 1 and 0 <= b <= 1:
                low, high = min(low, value), max(high, value)
    return min(max(total, low), high)


@kernel(
    "i8, i8, f4[:, ::1], f4[:, ::1], f8[:, ::1], f8[::1], f8[::1], f4[:, :, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f8, f8, i2, "
    "u2[:, :, ::1], f4[:, ::1], i2[:, ::1]",
    nogil=True, error_model="numpy",
)
def gather(
    lo: int,
    hi: int,
    position: Floats,  # (n, 3)
    normal: Floats,  # (n, 3) unit
    pose: Doubles,  # (3, 4) texels' frame -> camera
    centre: Doubles,  # (3,)
    lens: Doubles,  # fx, fy, cx, cy
    image: Floats,  # (h, w, c)
    mask: Floats,  # (h, w) weights
    depth: Floats,  # (h', w') depth map of the mesh, 0: nothing
    edge: Floats,  # (h', w') weights
    slack: float,
    view_weight: float,
    view: np.int16,
    values: Codes,  # (n, keep, c) samples of the best views so far
    weights: Floats,  # (n, keep)
    views: NDArray[np.int16],  # (n, keep)
) -> int:
    """Store this view in `values`, `weights` and `views` where it is among the best of the texels lo..hi; returns how many it shows."""
    height, width, channels = image.shape
    depth_h, depth_w = depth.shape
    scale_x, scale_y = depth_w / width, depth_h / height
    focal = np.sqrt(lens[0] * lens[1])
    keep = weights.shape[1]
    shown = 0
    for n in range(lo, hi):
        px, py, pz = position[n, 0], position[n, 1], position[n, 2]
        vx, vy, vz = centre[0] - px, centre[1] - py, centre[2] - pz
        away = np.sqrt(vx * vx + vy * vy + vz * vz)
        cosine = (vx * normal[n, 0] + vy * normal[n, 1] + vz * normal[n, 2]) / max(away, 1e-12)
        if not cosine > MIN_COSINE:
            continue
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        if not z > 1e-6:
            continue
        x = lens[0] * (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]) / z + lens[2]
        y = lens[1] * (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]) / z + lens[3]
        if not (x >= 1 and x <= width - 1 and y >= 1 and y <= height - 1):
            continue
        # Visible if no farther than the farthest of the four depths around it, with tolerance for its own slope within a pixel.
        i, j = int(np.floor(x * scale_x - 0.5)), int(np.floor(y * scale_y - 0.5))
        behind, beside = 0.0, 1.0
        for b in range(2):
            for a in range(2):
                row, column = min(max(j + b, 0), depth_h - 1), min(max(i + a, 0), depth_w - 1)
                behind = max(behind, depth[row, column])
                beside = min(beside, edge[row, column])
        slope = np.sqrt(max(0.0, 1 - cosine * cosine)) / cosine
        if not z <= behind + slack + slope * z / (focal * scale_x):
            continue
        w = mask[min(int(y), height - 1), min(int(x), width - 1)] * beside * view_weight
        w *= (cosine * focal / z / 1000.0) ** 2
        if not w > 0:
            continue
        worst = 0
        for k in range(1, keep):
            if weights[n, k] < weights[n, worst]:
                worst = k
        shown += 1
        if w > weights[n, worst]:
            weights[n, worst] = w
            views[n, worst] = view
            for c in range(channels):
                values[n, worst, c] = np.uint16(65535 * np.sqrt(min(max(_sample(image, x, y, c), 0.0), 1.0)) + 0.5)
    return shown
