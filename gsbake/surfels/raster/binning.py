"""Which surfels each 16x16 tile blends, front to back: one global depth sort, then a counting sort into tile lists (no sort per tile)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from gsbake.surfels.raster.blocks import JIT, TILE
from gsbake.surfels.raster.lanes import prefetch
from gsbake.surfels.raster.threads import thread_count

SHIFT = TILE.bit_length() - 1  # a division by TILE that knows nothing of negative numbers
LOOK_AHEAD = 8


@njit(**JIT)
def fill_tiles(order, box, tiles_x, offsets, cursor, ids, slots):  # type: ignore[no-untyped-def]
    """Counting sort: append each surfel, front to back, to the lists of the tiles its box touches."""
    last = order.shape[0] - 1
    for i in range(last + 1):
        coming = np.uint64(order[min(i + LOOK_AHEAD, last)])
        prefetch(box, coming, 0)
        prefetch(offsets, coming, 0)
        g = order[i]
        slot = offsets[g]
        for ty in range(box[g, 2] >> SHIFT, (box[g, 3] >> SHIFT) + 1):
            for tx in range(box[g, 0] >> SHIFT, (box[g, 1] >> SHIFT) + 1):
                tile = ty * tiles_x + tx
                at = cursor[tile]
                cursor[tile] = at + 1
                ids[at] = g
                slots[at] = slot
                slot += 1


@njit(**JIT)
def count_tiles(box, visible, tiles_x, per_tile, per_surfel):  # type: ignore[no-untyped-def]
    """How many pairs each tile and each surfel has; box (n, 4) int32 is clipped, inclusive xmin, xmax, ymin, ymax in pixels."""
    for g in range(box.shape[0]):
        n = 0
        if visible[g]:
            for ty in range(box[g, 2] >> SHIFT, (box[g, 3] >> SHIFT) + 1):
                for tx in range(box[g, 0] >> SHIFT, (box[g, 1] >> SHIFT) + 1):
                    per_tile[ty * tiles_x + tx] += 1
                    n += 1
        per_surfel[g] = n


@dataclass(frozen=True)
class Bins:
    """Tile lists: pairs of tile t are `ids[starts[t]:starts[t + 1]]`, front to back; `slots` their gradient slots."""

    starts: Any
    ids: Any
    slots: Any
    offsets: Any
    order: Any
    tiles_x: int


def bin_surfels(depth: Any, box: Any, visible: Any, width: int, height: int) -> Bins:
    """Depth-sort the visible surfels once and deal them to 16x16 tiles (numpy arrays in and out)."""
    n = len(depth)
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tiles = tiles_x * tiles_y
    idx = np.flatnonzero(visible).astype(np.uint64)
    # positive float32 sort as their bits; the index below keeps ties stable
    keys = (depth[idx.astype(np.int64)].view(np.uint32).astype(np.uint64) << np.uint64(32)) | idx
    keys.sort()
    front = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
    per_tile, per_surfel = np.zeros(tiles, np.int64), np.zeros(n, np.int64)
    count_tiles(box, visible, tiles_x, per_tile, per_surfel)
    starts, offsets = np.zeros(tiles + 1, np.int64), np.zeros(n + 1, np.int64)
    np.cumsum(per_tile, out=starts[1:])
    np.cumsum(per_surfel, out=offsets[1:])
    pairs = int(starts[-1])
    ids, slots = np.empty(pairs, np.int32), np.empty(pairs, np.int64)
    fill_tiles(front, box, tiles_x, offsets, starts[:-1].copy(), ids, slots)
    # heavy tiles first, dealt in turn to the chunks, so that both threads end together
    order = np.argsort(-per_tile, kind="stable")
    chunks = max(1, thread_count() * 6)
    order = np.concatenate([order[i::chunks] for i in range(chunks)])
    return Bins(starts, ids, slots, offsets, order, tiles_x)
