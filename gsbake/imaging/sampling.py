"""Bilinear image sampling.

OpenCV's remap takes a 2D map of at most 32 766 rows or columns; a list of points is reshaped to such a map.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

#: Columns of the map passed to OpenCV.
MAP_WIDTH = 4096


def bilinear_at_pixels(image: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """Bilinear values of `image` (h, w), in its own type, at columns `x` and rows `y` (equal shapes; pixel centres at integers).

    Points outside take the nearest border pixel.
    """
    count = x.size
    rows = max(1, -(-count // MAP_WIDTH))
    coordinates = np.zeros((2, rows * MAP_WIDTH), np.float32)
    coordinates[0, :count], coordinates[1, :count] = x.ravel(), y.ravel()
    map_x, map_y = coordinates.reshape(2, rows, MAP_WIDTH)
    value = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(value.ravel()[:count].reshape(x.shape))


def bilinear(image: NDArray[np.float32], uv: NDArray[np.float32], wrap: bool = True) -> NDArray[np.float32]:
    """Bilinear values (n, c) of an image (h, w, c) at uv (n, 2), texel centres at (i + .5) / size; repeated or clamped beyond 0..1."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - np.float32(0.5), uv[:, 1] * height - np.float32(0.5)
    col, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - col)[:, None].astype(np.float32), (y - row)[:, None].astype(np.float32)
    if wrap:
        left, right, top, bottom = col % width, (col + 1) % width, row % height, (row + 1) % height
    else:
        left, right = np.clip(col, 0, width - 1), np.clip(col + 1, 0, width - 1)
        top, bottom = np.clip(row, 0, height - 1), np.clip(row + 1, 0, height - 1)
    above = image[top, left] * (1 - fx) + image[top, right] * fx
    below = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return np.asarray(above * (1 - fy) + below * fy, np.float32)
