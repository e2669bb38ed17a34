"""Tile binning: per 16x16 tile the list of surfels, front to back, by one global depth sort and a counting sort into tiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import thread_count
from gsbake.surfels.raster.blocks import JIT, TILE
from gsbake.surfels.raster.lanes import prefetch

#: log2 of the tile size: a shift divides box coordinates, which are not negative, by `TILE`.
SHIFT = TILE.bit_length() - 1
#: Surfels between prefetch and use.
PREFETCH_DISTANCE = 8


@kernel("i8[::1], i4[:, ::1], i8, i8[::1], i8[::1], i4[::1], i8[::1]", **JIT)
def fill_tiles(order, box, tiles_x, offsets, cursor, ids, slots):  # type: ignore[no-untyped-def]
    """Counting sort: append each surfel, front to back, to the lists of the tiles that its box overlaps."""
    last = order.shape[0] - 1
    for i in range(last + 1):
        upcoming = np.uint64(order[min(i + PREFETCH_DISTANCE, last)])
        prefetch(box, upcoming, 0)
        prefetch(offsets, upcoming, 0)
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


@kernel("i4[:, ::1], b1[::1], i8, i8[::1], i8[::1]", **JIT)
def count_tiles(box, visible, tiles_x, per_tile, per_surfel):  # type: ignore[no-untyped-def]
    """Count (tile, surfel) pairs per tile and per surfel; box (n, 4) int32: xmin, xmax, ymin, ymax in pixels, clipped, inclusive."""
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
    """Tile lists. Tile t blends the surfels `ids[starts[t]:starts[t + 1]]`, front to back; `slots` are the gradient slots of these pairs.

    `offsets` (n + 1,) is the slot range of each surfel; `order` the sequence in which tiles are processed.
    """

    starts: Any
    ids: Any
    slots: Any
    offsets: Any
    order: Any
    tiles_x: int


def bin_surfels(depth: Any, box: Any, visible: Any, width: int, height: int) -> Bins:
    """Sort the visible surfels by depth and assign them to 16x16 tiles (numpy arrays in and out)."""
    n = len(depth)
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tiles = tiles_x * tiles_y
    idx = np.flatnonzero(visible).astype(np.uint64)
    # the bits of positive float32 sort like their values; the index in the low half keeps the sort stable
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
    # longest lists first, distributed round-robin over the chunks: balances the threads
    order = np.argsort(-per_tile, kind="stable")
    chunks = max(1, thread_count() * 6)
    order = np.concatenate([order[i::chunks] for i in range(chunks)])
    return Bins(starts, ids, slots, offsets, order, tiles_x)
