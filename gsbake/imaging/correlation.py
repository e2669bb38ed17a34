"""Normalised cross-correlation of two images in the window around each pixel, which exposure does not change."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


def window_mean(values: Floats, size: int) -> Floats:
    """Mean of `values` (h, w) in the window of `size` pixels around each pixel; mirrored at the border."""
    return np.asarray(cv2.blur(values, (size, size)), np.float32)


@dataclass(frozen=True)
class Windows:
    """Grey levels (h, w) of an image, and their mean and standard deviation in the window of `size` pixels around each pixel."""

    grey: Floats
    size: int
    mean: Floats
    deviation: Floats

    @staticmethod
    def of(grey: Floats, size: int) -> Windows:
        """The statistics of an image."""
        mean = window_mean(grey, size)
        return Windows(grey, size, mean, np.sqrt(np.maximum(window_mean(grey * grey, size) - mean * mean, 0)))

    def correlate(self, other: Windows, least: float) -> NDArray[np.bool_]:
        """Where (h, w) the correlation with an image of the same size exceeds `least`; nowhere in windows without any contrast."""
        covariance = window_mean(self.grey * other.grey, self.size) - self.mean * other.mean
        return np.asarray(covariance > least * self.deviation * other.deviation)

    def contrast(self, other: Windows) -> Floats:
        """The larger standard deviation (h, w) of both."""
        return np.maximum(self.deviation, other.deviation)
