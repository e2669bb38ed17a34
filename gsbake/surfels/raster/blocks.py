"""A tile in memory: 16x16 pixels as blocks of 4x2, the quantities of one block behind one another, eight lanes each.

Also the flags every rasteriser kernel is compiled with. `fastmath` leaves NaN alone ("nnan" would let a NaN pass every guard and crash);
`error_model="numpy"` because an exception on division would end every vectorised loop.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from gsbake.surfels.raster.lanes import BLOCK_X, BLOCK_Y, load, load_block, store, store_block

TILE = 16
ACROSS = TILE // BLOCK_X  # blocks per tile, across and down
DOWN = TILE // BLOCK_Y
U_TILE, U_ACROSS, U_BLOCK_X, U_BLOCK_Y = np.uint64(TILE), np.uint64(ACROSS), np.uint64(BLOCK_X), np.uint64(BLOCK_Y)
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}
JIT: dict[str, Any] = {"nogil": True, "fastmath": FAST, "error_model": "numpy", "cache": True, "boundscheck": False}


@njit(**JIT)
def unpack(s, at, block_size, image, plane, width, n_cols, n_rows):  # type: ignore[no-untyped-def]
    """Copy one quantity of a tile's blocks (at offset `at` of each) to where the tile starts, index `plane`, in a flat image."""
    if n_cols == U_TILE and n_rows == U_TILE:
        for b in range(np.uint64(ACROSS * DOWN)):
            at_b = plane + b // U_ACROSS * U_BLOCK_Y * width + b % U_ACROSS * U_BLOCK_X
            store_block(image, at_b, width, load(s, at + b * block_size))
    else:
        for y in range(n_rows):
            for x in range(n_cols):
                base = at + ((y // U_BLOCK_Y) * U_ACROSS + x // U_BLOCK_X) * block_size
                image[plane + y * width + x] = s[base + (y % U_BLOCK_Y) * U_BLOCK_X + x % U_BLOCK_X]


@njit(**JIT)
def pack(image, plane, width, s, at, block_size, n_cols, n_rows):  # type: ignore[no-untyped-def]
    """The way back of `unpack`; lanes beyond the frame stay as they are."""
    if n_cols == U_TILE and n_rows == U_TILE:
        for b in range(np.uint64(ACROSS * DOWN)):
            at_b = plane + b // U_ACROSS * U_BLOCK_Y * width + b % U_ACROSS * U_BLOCK_X
            store(s, at + b * block_size, load_block(image, at_b, width))
    else:
        for y in range(n_rows):
            for x in range(n_cols):
                base = at + ((y // U_BLOCK_Y) * U_ACROSS + x // U_BLOCK_X) * block_size
                s[base + (y % U_BLOCK_Y) * U_BLOCK_X + x % U_BLOCK_X] = image[plane + y * width + x]
