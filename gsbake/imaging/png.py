"""8-bit PNG: grey levels of files, encoding of the asset's files through Pillow and of intermediate ones through OpenCV.

Encoded bytes depend on the pixels only; there are no gAMA, iCCP or other ancillary chunks.

A photographic texture of 1024² texels takes 1.7 s at deflate level 9, 1 s at level 8 (1 % more bytes) and 0.2 s at level 6 (4 % more).
Photos have next to no strings that repeat: intermediate files code run lengths alone, which takes 4 to 18 % less than deflate level 1 (four
captures; masks two thirds) in three quarters of the time.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

#: How intermediate files, which are not part of the asset, are encoded.
_FAST = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE, cv2.IMWRITE_PNG_FILTER)


def encode_png(pixels: NDArray[np.uint8], level: int = 8) -> bytes:
    """Encode 8-bit grey (h, w) or (h, w, 1), RGB (h, w, 3) or RGBA (h, w, 4) `pixels` with deflate `level` 1..9."""
    image = np.ascontiguousarray(pixels, np.uint8)
    content = io.BytesIO()
    Image.fromarray(image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image).save(content, "PNG", compress_level=level)
    return content.getvalue()


def read_grey(path: Path) -> NDArray[np.uint8]:
    """Grey levels (h, w) of an image file. Raises FileNotFoundError when it is missing or cannot be decoded."""
    grey: Any = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FileNotFoundError(path)
    return np.asarray(grey, np.uint8)


def encode_fast(pixels: NDArray[np.uint8]) -> bytes:
    """Encode 8-bit grey (h, w) or RGB (h, w, 3) `pixels` of an intermediate file."""
    grey = pixels.ndim == 2
    image = np.ascontiguousarray(pixels if grey else pixels[..., ::-1], np.uint8)
    return cv2.imencode(".png", image, (*_FAST, cv2.IMWRITE_PNG_FILTER_UP if grey else cv2.IMWRITE_PNG_ALL_FILTERS))[1].tobytes()


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write `pixels` as in `encode_fast`. Raises OSError when the file cannot be written."""
    path.write_bytes(encode_fast(pixels))
