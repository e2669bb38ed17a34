"""How alike two images are: PSNR and SSIM (Wang et al., *Image quality assessment*, IEEE TIP 2004)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: A perfect match would be infinite decibels, which no JSON can hold.
MAX_PSNR = 100.0


def decibels(mean_squared_error: float) -> float:
    """PSNR in dB, at most `MAX_PSNR`, of a mean squared error of values in 0..1."""
    return -10 * math.log10(max(mean_squared_error, 10 ** (-MAX_PSNR / 10)))


def psnr(a: NDArray[Any], b: NDArray[Any], where: NDArray[np.bool_]) -> float:
    """PSNR in dB of two images (h, w, 3), values 0..1, over the pixels `where` (h, w); 0 without any pixel."""
    if not where.any():
        return 0.0
    return decibels(float(np.mean(np.square(a[where].astype(np.float64) - b[where]))))


def ssim(a: NDArray[Any], b: NDArray[Any], where: NDArray[np.bool_]) -> float:
    """Mean SSIM with Gaussian weights of two images (h, w, 3), values 0..1, over the pixels `where` (h, w).

    0 without any pixel or in images smaller than the window.
    """
    from skimage.metrics import structural_similarity

    if not where.any() or min(a.shape[:2]) < 11:
        return 0.0
    _, every = structural_similarity(
        a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )  # fmt: skip
    return float(np.asarray(every).mean(axis=2)[where].mean())
