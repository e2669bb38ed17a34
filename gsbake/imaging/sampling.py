"""Pictures read between their pixels, at any number of places.

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
