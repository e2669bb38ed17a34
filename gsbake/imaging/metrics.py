"""Similarity of two images: PSNR and SSIM (Wang et al., *Image quality assessment*, IEEE TIP 2004)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Maximum PSNR in dB: JSON has no infinity for equal images.
MAX_PSNR = 100.0


def decibels(mean_squared_error: float) -> float:
    """PSNR in dB, at most `MAX_PSNR`, from the mean squared error of values in 0..1."""
    return -10 * math.log10(max(mean_squared_error, 10 ** (-MAX_PSNR / 10)))


def psnr(a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_]) -> float:
    """PSNR in dB of two images (h, w, 3), values 0..1, over the pixels in `mask` (h, w); 0 for an empty mask."""
    if not mask.any():
        return 0.0
    return decibels(float(np.mean(np.square(a[mask].astype(np.float64) - b[mask]))))


def ssim(a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_]) -> float:
    """Mean SSIM with Gaussian weights of two images (h, w, 3), values 0..1, over the pixels in `mask` (h, w).

    0 for an empty mask or images smaller than the window.
    """
    from skimage.metrics import structural_similarity

    if not mask.any() or min(a.shape[:2]) < 11:
        return 0.0
    _, ssim_map = structural_similarity(
        a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )  # fmt: skip
    return float(np.asarray(ssim_map).mean(axis=2)[mask].mean())
