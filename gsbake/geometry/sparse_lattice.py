"""Sparse lattice of blocks of 8³ samples.

Sample (i, j, k) lies at `lower + cell * (i, j, k)`; block (a, b, c) contains the samples 8a … 8a+7 along each axis. Values are separate
arrays of shape (n, 8, 8, 8) in the order of allocation; the lattice only stores where each block lies.
Memory grows with the number of blocks (with the surface), plus one 4-byte index per possible block.

Nießner et al., *Real-time 3D reconstruction at scale using voxel hashing*, SIGGRAPH Asia 2013 (here with a table instead of a
hash: the object fills its box, so a table is smaller and has no collisions).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsbake.kernels.declaration import kernel

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

#: Samples along a block's edge.
EDGE = 8


class BlockLattice:
    """Blocks between `lower` and `upper` (3,) with sample spacing `cell`; initially none is allocated.

    `shape` is the number of possible blocks per axis, `coords` (n, 3) int32 the allocated ones, `index` the table from block to row
    of `coords` (-1 = not allocated). Raises ValueError for an empty box.
    """

    def __init__(self, lower: ArrayLike, upper: ArrayLike, cell: float) -> None:
        self.lower = np.asarray(lower, np.float64).reshape(3)
        self.cell = float(cell)
        samples = np.ceil((np.asarray(upper, np.float64).reshape(3) - self.lower) / self.cell).astype(int) + 1
        if not (samples > 1).all():
            raise ValueError("the upper corner must exceed the lower one on every axis")
        blocks = -(-samples // EDGE)
        self.shape: tuple[int, int, int] = (int(blocks[0]), int(blocks[1]), int(blocks[2]))
        self.index = np.full(self.shape, -1, np.int32)
        self.coords: Ints = np.zeros((0, 3), np.int32)

    def __len__(self) -> int:
        return len(self.coords)

    @property
    def samples(self) -> tuple[int, int, int]:
        """Number of samples per axis over all possible blocks."""
        return self.shape[0] * EDGE, self.shape[1] * EDGE, self.shape[2] * EDGE

    def allocate(self, marked: NDArray[np.bool_]) -> None:
        """Allocate every block marked in `marked` (of `shape`) that is not allocated yet, in a fixed order."""
        new = np.argwhere(marked & (self.index < 0)).astype(np.int32)
        start = len(self.coords)
        self.index[tuple(new.T)] = np.arange(start, start + len(new), dtype=np.int32)
        self.coords = np.concatenate([self.coords, new])

    def allocate_all(self) -> None:
        """Allocate every block: a dense lattice."""
        self.allocate(np.ones(self.shape, np.bool_))

    def mark_blocks_near(self, points: ArrayLike, radius: float, marked: NDArray[np.bool_]) -> None:
        """Mark in `marked` (of `shape`) the blocks with samples within `radius` (per axis) of any of `points` (n, 3)."""
        scaled = np.ascontiguousarray((np.asarray(points, np.float64).reshape(-1, 3) - self.lower) / self.cell, np.float64)
        _mark_blocks(scaled, radius / self.cell, marked)

    def positions(self, blocks: slice) -> Floats:
        """Sample positions (m, 8, 8, 8, 3) of a slice of the allocated blocks."""
        steps = np.arange(EDGE)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
        sample_index = self.coords[blocks, None, None, None].astype(np.int64) * EDGE + offsets
        return (self.lower + self.cell * sample_index).astype(np.float32)

    def dense(self, values: Floats) -> Floats:
        """The values (n, 8, 8, 8) as one array of shape `samples`; NaN where no block is allocated. For small lattices."""
        start = np.zeros(3, np.int64)
        out = np.full(self.samples, np.nan, np.float32)
        gather_samples(self.index, values, start, out)
        return out


@kernel("f8[:, ::1], f8, b1[:, :, ::1]")
def _mark_blocks(scaled: Any, radius: float, marked: Any) -> None:
    """Mark blocks with samples within `radius` of `scaled` (n, 3); lengths in cells."""
    for p in range(scaled.shape[0]):
        lo0 = max(0, int(np.floor((scaled[p, 0] - radius) / EDGE)))
        lo1 = max(0, int(np.floor((scaled[p, 1] - radius) / EDGE)))
        lo2 = max(0, int(np.floor((scaled[p, 2] - radius) / EDGE)))
        hi0 = min(marked.shape[0] - 1, int(np.floor((scaled[p, 0] + radius) / EDGE)))
        hi1 = min(marked.shape[1] - 1, int(np.floor((scaled[p, 1] + radius) / EDGE)))
        hi2 = min(marked.shape[2] - 1, int(np.floor((scaled[p, 2] + radius) / EDGE)))
        for a in range(lo0, hi0 + 1):
            for b in range(lo1, hi1 + 1):
                for c in range(lo2, hi2 + 1):
                    marked[a, b, c] = True


@kernel("i4[:, :, ::1], f4[:, :, :, ::1], i8[::1], f4[:, :, ::1]")
def gather_samples(index: Any, values: Any, start: Any, out: Any) -> None:
    """Copy the samples from lattice sample `start` (3,) on into the dense `out`; samples of missing blocks are not written."""
    for i in range(out.shape[0]):
        gi = start[0] + i
        if gi < 0 or gi >= index.shape[0] * EDGE:
            continue
        for j in range(out.shape[1]):
            gj = start[1] + j
            if gj < 0 or gj >= index.shape[1] * EDGE:
                continue
            row = -1
            last = -1
            for k in range(out.shape[2]):
                gk = start[2] + k
                if gk < 0 or gk >= index.shape[2] * EDGE:
                    continue
                if gk // EDGE != last:
                    last = gk // EDGE
                    row = index[gi // EDGE, gj // EDGE, last]
                if row >= 0:
                    out[i, j, k] = values[row, gi % EDGE, gj % EDGE, gk % EDGE]
