"""JPEG images in memory."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """JPEG of grey (h, w) or RGB (h, w, 3) pixels, every channel at full resolution."""
    pixels = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    done, data = cv2.imencode(".jpg", pixels, options)
    if not done:
        raise RuntimeError(f"could not encode an image of shape {image.shape} as JPEG")
    return bytes(data.tobytes())
