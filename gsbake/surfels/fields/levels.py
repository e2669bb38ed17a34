"""Levels of feature tables: the one form of all grids of the fields.

A level holds samples at lattice corners, each with D features, of which a point blends eight. Levels differ in how a corner finds its
row: dense (row-major), hashed (Müller et al., *Instant neural graphics primitives*, SIGGRAPH 2022), by a table of corners (a sparse
octree), or by a table of blocks of 8³ corners (sparse voxels). A level with one sample along an axis does not depend on it: planes and
lines of a factorised tensor are such levels.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

#: How a corner finds its row.
DENSE, HASHED, CORNERS, BLOCKS = range(4)
#: Edge of a block of corners.
EDGE = 8
#: Multipliers of the spatial hash (the first axis has 1).
PRIMES = (2_654_435_761, 805_459_861)


@dataclass(frozen=True)
class Level:
    """One lattice: `size` (3,) corners per axis over the whole box, `mode`, `rows` of its table.

    `index` is the table of corners (nx, ny, nz) or of blocks, with -1 where there is none, whose features are 0.
    """

    size: tuple[int, int, int]
    mode: int
    rows: int
    index: NDArray[np.int32] | None = None


@dataclass(frozen=True)
class Levels:
    """Several levels over the box `lower`..`upper` (3,), their tables one after the other in one tensor (rows, D)."""

    lower: NDArray[np.float32]
    upper: NDArray[np.float32]
    levels: tuple[Level, ...]
    numbers: NDArray[np.int64] = field(init=False, repr=False)
    scale: NDArray[np.float32] = field(init=False, repr=False)
    index: NDArray[np.int32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        numbers, tables = [], []
        row = at = 0
        for level in self.levels:
            shape = (0, 0, 0) if level.index is None else level.index.shape
            numbers.append([level.mode, *level.size, row, level.rows, at, *shape])
            row += level.rows
            if level.index is not None:
                tables.append(np.ascontiguousarray(level.index, np.int32).reshape(-1))
                at += level.index.size
        extent = np.maximum(np.asarray(self.upper, np.float32) - self.lower, 1e-12)
        scale = [[(n - 1) / e for n, e in zip(level.size, extent, strict=True)] for level in self.levels]
        object.__setattr__(self, "numbers", np.array(numbers, np.int64).reshape(len(self.levels), 10))
        object.__setattr__(self, "scale", np.array(scale, np.float32).reshape(len(self.levels), 3))
        object.__setattr__(self, "index", np.concatenate(tables) if tables else np.zeros(1, np.int32))

    @property
    def rows(self) -> int:
        """Rows of the table."""
        return sum(level.rows for level in self.levels)
