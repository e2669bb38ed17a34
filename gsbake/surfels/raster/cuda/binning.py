"""Which surfels each tile blends, front to back, by torch on the device: the twin of `raster.binning`, same lists, same ties."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

#: Edge of a tile in pixels.
TILE = 16


@dataclass(frozen=True)
class Bins:
    """Pairs of tile t are `ids[starts[t]:starts[t + 1]]`, front to back; `slots` their rows when pairs are ordered by surfel: the j-th of
    the surfels `front` (nearest first) owns `counts[j]` rows, one after the other."""

    starts: Tensor
    ids: Tensor
    slots: Tensor
    front: Tensor
    counts: Tensor
    tiles_x: int


def bin_surfels(depth: Tensor, box: Tensor, visible: Tensor, width: int, height: int) -> Bins:
    """Depth-sort the visible surfels once and deal them to 16x16 tiles; depth (n,), box (n, 4) inclusive pixels, visible (n,)."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    front = visible.nonzero()[:, 0]
    front = front[torch.argsort(depth[front], stable=True)]
    x_lo, x_hi, y_lo, y_hi = torch.div(box[front].long(), TILE, rounding_mode="floor").unbind(1)
    across = x_hi - x_lo + 1
    counts = across * (y_hi - y_lo + 1)
    pairs = int(counts.sum())
    rank = torch.repeat_interleave(torch.arange(len(front), device=depth.device), counts, output_size=pairs)
    within = torch.arange(pairs, device=depth.device) - (counts.cumsum(0) - counts)[rank]
    row = torch.div(within, across[rank], rounding_mode="floor")
    tile = (y_lo[rank] + row) * tiles_x + x_lo[rank] + within - row * across[rank]
    # the sort is stable, so that within a tile the order stays front to back
    tile, slots = torch.sort(tile.int(), stable=True)
    starts = torch.searchsorted(tile, torch.arange(tiles_x * tiles_y + 1, device=depth.device, dtype=torch.int32))
    return Bins(starts, front[rank[slots]].int(), slots, front, counts, tiles_x)
