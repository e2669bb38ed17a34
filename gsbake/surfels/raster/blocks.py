"""Memory layout of a tile: 16x16 pixels as blocks of 4x2; a block stores its quantities one after the other, eight lanes each.

Also the compile options of every rasteriser kernel. Fast math excludes "nnan": a NaN would pass every guard and index out of bounds.
`error_model="numpy"` because an exception on division prevents vectorisation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from gsbake.surfels.raster.lanes import BLOCK_X, BLOCK_Y, load, load_block, store, store_block

#: Side of a tile in pixels.
TILE = 16
#: Blocks per tile, horizontally and vertically.
BLOCKS_ACROSS, BLOCKS_DOWN = TILE // BLOCK_X, TILE // BLOCK_Y
U_TILE, U_BLOCKS_ACROSS, U_BLOCK_X, U_BLOCK_Y = np.uint64(TILE), np.uint64(BLOCKS_ACROSS), np.uint64(BLOCK_X), np.uint64(BLOCK_Y)
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}
JIT: dict[str, Any] = {"nogil": True, "fastmath": FASTMATH, "error_model": "numpy", "cache": True, "boundscheck": False}


@njit(**JIT)
def unpack(s, at, block_size, image, plane, width, n_cols, n_rows):  # type: ignore[no-untyped-def]
    """Copy one quantity of a tile's blocks, at offset `at` of each, to a flat image; `plane` is the index of the tile's first pixel."""
    if n_cols == U_TILE and n_rows == U_TILE:
        for b in range(np.uint64(BLOCKS_ACROSS * BLOCKS_DOWN)):
            at_b = plane + b // U_BLOCKS_ACROSS * U_BLOCK_Y * width + b % U_BLOCKS_ACROSS * U_BLOCK_X
            store_block(image, at_b, width, load(s, at + b * block_size))
    else:
        for y in range(n_rows):
            for x in range(n_cols):
                base = at + ((y // U_BLOCK_Y) * U_BLOCKS_ACROSS + x // U_BLOCK_X) * block_size
                image[plane + y * width + x] = s[base + (y % U_BLOCK_Y) * U_BLOCK_X + x % U_BLOCK_X]


@njit(**JIT)
def pack(image, plane, width, s, at, block_size, n_cols, n_rows):  # type: ignore[no-untyped-def]
    """Inverse of `unpack`; lanes outside the image stay unchanged."""
    if n_cols == U_TILE and n_rows == U_TILE:
        for b in range(np.uint64(BLOCKS_ACROSS * BLOCKS_DOWN)):
            at_b = plane + b // U_BLOCKS_ACROSS * U_BLOCK_Y * width + b % U_BLOCKS_ACROSS * U_BLOCK_X
            store(s, at + b * block_size, load_block(image, at_b, width))
    else:
        for y in range(n_rows):
            for x in range(n_cols):
                base = at + ((y // U_BLOCK_Y) * U_BLOCKS_ACROSS + x // U_BLOCK_X) * block_size
                s[base + (y % U_BLOCK_Y) * U_BLOCK_X + x % U_BLOCK_X] = image[plane + y * width + x]
