"""sRGB tone curve (IEC 61966-2-1) for NumPy arrays; `imaging.srgb_torch` has the differentiable version."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: SLOPE · linear up to LINEAR_THRESHOLD (SRGB_THRESHOLD in sRGB), SCALE · linear^(1 / GAMMA) − OFFSET above.
LINEAR_THRESHOLD, SRGB_THRESHOLD, SLOPE = 0.0031308, 0.04045, 12.92
SCALE, OFFSET, GAMMA = 1.055, 0.055, 2.4
#: Weights of the linear channels in the luminance (ITU-R BT.709).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def _decoded(value: NDArray[Any]) -> NDArray[Any]:
    return np.where(value <= SRGB_THRESHOLD, value / SLOPE, ((value + OFFSET) / SCALE) ** GAMMA)


def _encoded(value: NDArray[Any]) -> NDArray[Any]:
    return np.where(value <= LINEAR_THRESHOLD, SLOPE * value, SCALE * value ** (1 / GAMMA) - OFFSET)


#: Linear value of each 8-bit sRGB code.
LINEAR_OF_BYTE = _decoded(np.arange(256) / 255).astype(np.float32)


def decode_bytes(coded: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear float32 values of 8-bit sRGB `coded`, of the same shape."""
    return np.asarray(LINEAR_OF_BYTE[coded], np.float32)


def decode(coded: NDArray[Any]) -> NDArray[np.float32]:
    """Linear float32 values of sRGB `coded` in 0..1."""
    return np.asarray(_decoded(np.asarray(coded, np.float32)), np.float32)


def encode(linear: NDArray[Any]) -> NDArray[np.float32]:
    """sRGB values in 0..1 of linear values (clipped to 0..1)."""
    return np.asarray(_encoded(np.clip(np.asarray(linear, np.float32), 0, 1)), np.float32)


def encode_bytes(linear: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit sRGB codes of linear values (clipped to 0..1), rounded to nearest; computed in the precision of `linear`."""
    return np.asarray(np.rint(255 * _encoded(np.clip(np.asarray(linear), 0, 1))), np.uint8)
