"""Robust fusion of the best views of each texel: exposure gains, weighted median, reweighted mean.

Deviations are measured on square roots of linear values, which are about uniform in perception and in camera noise.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

Floats = NDArray[np.float32]
Codes = NDArray[np.uint16]

#: Deviations (of square roots) below this are noise, whatever the spread of a texel's views.
NOISE_FLOOR = 0.02
#: Power of a view's weight in the final mean: a higher one favours the best view (sharper, more seams).
SHARPNESS = 2.0
#: Texels used to solve for the gains.
GAIN_TEXELS = 30_000
#: Fewer texels tell no gains.
MIN_TEXELS = 100
#: Linear values from which a photo is clipped.
CLIPPED = 0.96
#: Rounds of the gain solver.
GAIN_ROUNDS = 12


@numba.njit(cache=True, error_model="numpy")
def _median(value: NDArray[np.float64], weight: NDArray[np.float64], count: int, order: NDArray[np.int64]) -> float:
    """Weighted median of the first `count` values; halfway between two when the weight splits evenly."""
    total = 0.0
    for k in range(count):
        order[k] = k
        total += weight[k]
        m = k
        while m > 0 and value[order[m - 1]] > value[order[m]]:
            order[m - 1], order[m] = order[m], order[m - 1]
            m -= 1
    run = 0.0
    for k in range(count):
        run += weight[order[k]]
        if run > 0.5 * total * (1 + 1e-9):
            return value[order[k]]
        if run > 0.5 * total * (1 - 1e-9) and k + 1 < count:
            return 0.5 * (value[order[k]] + value[order[k + 1]])
    return value[order[count - 1]]


@kernel("i8, i8, u2[:, :, ::1], f4[:, ::1], i2[:, ::1], f4[:, ::1], f4[:, ::1], i4[::1], f4[::1]", nogil=True, error_model="numpy")
def _fuse(
    lo: int, hi: int, values: Codes, weights: Floats, views: NDArray[np.int16], gains: Floats, out: Floats, view_count: NDArray[np.int32],
    confidence: Floats,
) -> None:  # fmt: skip
    """Kernel of `fuse` for the texels lo..hi."""
    keep, channels = values.shape[1], values.shape[2]
    root, weight, deviation, order = np.zeros((channels, keep)), np.zeros(keep), np.zeros(keep), np.zeros(keep, np.int64)
    for n in range(lo, hi):
        m = 0
        for k in range(keep):
            if weights[n, k] > 0:
                weight[m] = weights[n, k]
                for c in range(channels):
                    root[c, m] = values[n, k, c] / 65535.0 / np.sqrt(gains[views[n, k], c])
                m += 1
        view_count[n] = m
        if m == 0:
            continue
        deviation[:m] = 0.0
        for c in range(channels):
            centre = _median(root[c], weight, m, order)
            for k in range(m):
                deviation[k] += (root[c, k] - centre) ** 2 / channels
        for k in range(m):
            deviation[k] = np.sqrt(deviation[k])
        spread = NOISE_FLOOR + _median(deviation, weight, m, order)
        best = 0.0
        for k in range(m):
            best = max(best, weight[k])
        total, support = 0.0, 0.0
        for k in range(m):
            robust = np.exp(-0.5 * (deviation[k] / spread) ** 2)
            w = (weight[k] / best) ** SHARPNESS * robust
            support += weight[k] / best * robust
            total += w
            for c in range(channels):
                out[n, c] += w * root[c, k] ** 2
        for c in range(channels):
            out[n, c] /= max(total, 1e-12)
        confidence[n] = 1 - np.exp(-support)


def fuse(values: Codes, weights: Floats, views: NDArray[np.int16], gains: Floats) -> tuple[Floats, NDArray[np.int32], Floats]:
    """Fused values (n, c), number of views (n,) and confidence (n,) 0..1.

    `values` (n, keep, c) are coded as `gather` does; `weights` (n, keep); `views` (n, keep); `gains` (views, c).
    """
    count, _, channels = values.shape
    out, view_count, confidence = np.zeros((count, channels), np.float32), np.zeros(count, np.int32), np.zeros(count, np.float32)
    run_chunks(lambda lo, hi: _fuse(lo, hi, values, weights, views, gains, out, view_count, confidence), count)
    return out, view_count, confidence


def log_samples(
    values: Codes, weights: Floats, views: NDArray[np.int16]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Logarithms (m, keep, c) of linear samples of some GAIN_TEXELS texels, the views (m, keep) they are from, and the texels (m,).

    NaN is what is clipped or dark; texels are those that three or more views show otherwise.

    `values` (n, keep, c), `weights` (n, keep) and `views` (n, keep) are those of `fuse`.
    """
    shared = np.flatnonzero((weights > 0).sum(1) >= 3)
    chosen = shared[:: max(1, len(shared) // GAIN_TEXELS)]
    linear = (values[chosen] / 65535.0) ** 2
    usable = (weights[chosen] > 0) & (linear > 0.004).all(2) & (linear < CLIPPED).all(2)
    logs = np.where(usable[..., None], np.log(np.maximum(linear, 1e-4)), np.nan)
    enough = usable.sum(1) >= 3
    return logs[enough], np.maximum(views[chosen[enough]], 0).astype(np.int64), chosen[enough]


def solve_gains(logs: NDArray[np.float64], view: NDArray[np.int64], count: int) -> Floats:
    """Gain (count, c) of each view relative to the others, with geometric mean 1, from samples `logs` (n, keep, c) of the views `view`
    (n, keep), as `log_samples` makes them; 1 where fewer than MIN_TEXELS tell of them.

    Alternates between each texel's median and each view's median ratio to it, in logarithms.
    """
    gains = np.zeros((count, logs.shape[2]))
    if len(logs) < MIN_TEXELS:
        return np.ones(gains.shape, np.float32)
    usable = np.isfinite(logs[..., 0])
    for _ in range(GAIN_ROUNDS):
        centre = np.nanmedian(logs - gains[view], axis=1, keepdims=True)
        ratio = logs - centre
        for v in range(count):
            mine = ratio[(view == v) & usable]
            # Few shared texels are weak evidence: shrink towards no gain.
            if len(mine):
                gains[v] = np.median(mine, axis=0) * len(mine) / (len(mine) + 50)
        gains -= gains.mean(0)
    return np.exp(np.clip(gains, -1.5, 1.5)).astype(np.float32)


def disagreement(logs: NDArray[np.float64], view: NDArray[np.int64], gains: NDArray[np.floating]) -> float:
    """Mean absolute deviation of the samples `logs` (n, keep, c) from their texel's median, `gains` (views, c) divided out."""
    equal = logs - np.log(gains)[view]
    return float(np.nanmean(np.abs(equal - np.nanmedian(equal, axis=1, keepdims=True))))
