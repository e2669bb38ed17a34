"""Images sampled between their pixels.

OpenCV reads a picture at a map of places, and a map may have no more than 32 766 rows or columns; a list of places is laid out in rows.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

#: Places of one row of the map that OpenCV is given.
ROW = 4096


def read_at(picture: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """The `picture` (h, w), bilinear, at columns `x` and rows `y` (any one shape; pixel centres are whole numbers), in its own type.

    Places outside show the nearest border pixel.
    """
    count = x.size
    rows = max(1, -(-count // ROW))
    places = np.zeros((2, rows * ROW), np.float32)
    places[0, :count], places[1, :count] = x.ravel(), y.ravel()
    columns, lines = places.reshape(2, rows, ROW)
    value = cv2.remap(picture, columns, lines, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(value.ravel()[:count].reshape(x.shape))


def bilinear(image: NDArray[np.float32], uv: NDArray[np.float32], wrap: bool = True) -> NDArray[np.float32]:
    """Values (n, c) of an image (h, w, c) at uv (n, 2), texel centres at (i + .5) / size; beyond 0..1 repeated or clamped."""
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
