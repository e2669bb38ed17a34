"""A sparse voxel grid: a dense coarse lattice, and blocks of finer corners near the surface that hold the difference to it.

Both are interpolated trilinearly (Curless & Levoy, SIGGRAPH 1996; sparse as in Nießner et al. 2013). Corners without a block have no
difference, so the field is continuous. As a sum of two levels it is optimised like a two-grid method: the coarse one moves what is smooth.
Blocks follow the surface: `advance` allocates them anew around the zero level set.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.interpolation import interpolate
from gsbake.surfels.fields.known import Known
from gsbake.surfels.fields.levels import BLOCKS, DENSE, EDGE, Level, Levels

#: Cells of the coarse lattice per fine cell along an axis.
COARSENING = 4
#: Blocks are allocated within this many fine cells of the surface.
BAND_CELLS = 4.0
#: Shares of the run at which blocks are allocated anew.
ALLOCATIONS = (0.2, 0.45, 0.7)
#: Rate in cells of the level per step.
RATE_CELLS = 0.05


def corner_positions(lower: NDArray[np.float32], cell: float, corners: NDArray[np.integer]) -> NDArray[np.float64]:
    """Positions (n, 3) of integer corners (n, 3)."""
    return lower.astype(float) + cell * corners


class GridField(ContinuousField):
    """Trilinear distances in sparse blocks."""

    name = "grid"

    def start(self, known: Known, seed: int) -> None:
        """Known distances at the coarse corners, and at the fine ones near the surface."""
        cells = max(COARSENING, self.settings.resolution)
        # a cube, so that all cells are cubes: levels share one scale per axis
        centre, edge = (self.lower + self.upper) / 2, float((self.upper - self.lower).max())
        self.lower, self.upper = centre - edge / 2, centre + edge / 2
        self.coarse_size = -(-cells // COARSENING) + 1
        self.fine_size = (self.coarse_size - 1) * COARSENING + 1
        lower = self.lower.numpy()
        corners = np.stack(np.meshgrid(*[np.arange(self.coarse_size)] * 3, indexing="ij"), -1).reshape(-1, 3)
        self.coarse = torch.from_numpy(known(corner_positions(lower, edge / (self.coarse_size - 1), corners)))[:, None].contiguous()
        side = -(-self.fine_size // EDGE)
        self._allocate(np.zeros((side, side, side), np.int32) - 1, torch.zeros(0, 1))
        self._fit_blocks(known)
        self.allocations = 0

    def _allocate(self, index: NDArray[np.int32], fine: Tensor) -> None:
        self.index, self.fine = index, fine.contiguous()
        box = self.lower.numpy(), self.upper.numpy()
        self.coarse_levels = Levels(*box, (Level((self.coarse_size,) * 3, DENSE, len(self.coarse)),))
        self.fine_levels = Levels(*box, (Level((self.fine_size,) * 3, BLOCKS, len(fine), index),))

    @property
    def cell(self) -> float:
        """Size of a fine cell."""
        return float(self.upper[0] - self.lower[0]) / (self.fine_size - 1)

    def _blocks_near_zero(self) -> NDArray[np.int64]:
        """Blocks (b, 3) within the band around the zero level set."""
        with torch.no_grad():
            side = self.index.shape[0]
            blocks = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
            # corners every half block: the field changes by at most the distance between them
            steps = np.stack(np.meshgrid(*[np.arange(0, EDGE + 1, EDGE // 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
            corners = (blocks[:, None] * EDGE + steps).reshape(-1, 3)
            points = torch.from_numpy(corner_positions(self.lower.numpy(), self.cell, corners).astype(np.float32))
            nearest = self.value(points).abs().view(len(blocks), -1).amin(1).numpy()
        return np.asarray(blocks[nearest < (BAND_CELLS + EDGE * 0.45) * self.cell])

    def _corners_of(self, blocks: NDArray[np.int64]) -> NDArray[np.int64]:
        steps = np.stack(np.meshgrid(*[np.arange(EDGE)] * 3, indexing="ij"), -1).reshape(-1, 3)
        return np.asarray((blocks[:, None] * EDGE + steps).reshape(-1, 3))

    def _fit_blocks(self, known: Known) -> None:
        """Allocate blocks near the surface and give them the differences between the known distance and the coarse level."""
        blocks = self._blocks_near_zero()
        index = np.full(self.index.shape, -1, np.int32)
        index[tuple(blocks.T)] = np.arange(len(blocks))
        corners = corner_positions(self.lower.numpy(), self.cell, self._corners_of(blocks))
        points = torch.from_numpy(corners.astype(np.float32))
        with torch.no_grad():
            coarse = interpolate(points, self.coarse, self.coarse_levels)[0][:, 0] if len(points) else torch.zeros(0)
        target = torch.from_numpy(known(corners)) if len(points) else torch.zeros(0)
        self._allocate(index, (target - coarse)[:, None])

    def advance(self, share: float) -> bool:
        """Allocate the blocks anew as the surface moves; corners that stay keep their values."""
        due = sum(share >= at for at in ALLOCATIONS)
        if due <= self.allocations:
            return False
        self.allocations = due
        blocks = self._blocks_near_zero()
        index = np.full(self.index.shape, -1, np.int32)
        index[tuple(blocks.T)] = np.arange(len(blocks))
        if np.array_equal(index >= 0, self.index >= 0):
            return False
        fine = torch.zeros(len(blocks), EDGE**3)
        before = self.index[tuple(blocks.T)].astype(np.int64)
        kept = torch.from_numpy(before >= 0)
        fine[kept] = self.fine.view(-1, EDGE**3)[torch.from_numpy(before[before >= 0])]
        self._allocate(index, fine.view(-1, 1))
        self._at = None
        return True

    def _inside(self, points: Tensor) -> tuple[Tensor, Tensor]:
        f, g = interpolate(points, self.coarse, self.coarse_levels)
        if len(self.fine):
            df, dg = interpolate(points, self.fine, self.fine_levels)
            f, g = f + df, g + dg
        return f[:, 0], g[:, :, 0]

    def own_parameters(self) -> dict[str, Tensor]:
        """Both tables."""
        return {"coarse": self.coarse} | ({"fine": self.fine} if len(self.fine) else {})

    def own_rates(self) -> dict[str, float]:
        """Cells per step."""
        rate = self.settings.rate * RATE_CELLS * self.cell
        return {"coarse": rate, "fine": rate}

    def own_tensors(self) -> dict[str, Tensor]:
        """Box, tables and blocks."""
        numbers = torch.tensor([self.coarse_size, self.fine_size, self.allocations])
        return {
            "lower": self.lower, "upper": self.upper, "numbers": numbers, "coarse": self.coarse, "fine": self.fine,
            "index": torch.from_numpy(self.index),
        }  # fmt: skip

    def load_own(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `own_tensors` returned."""
        self.lower, self.upper, self.coarse = tensors["lower"], tensors["upper"], tensors["coarse"].contiguous()
        self.coarse_size, self.fine_size, self.allocations = (int(n) for n in tensors["numbers"])
        self._allocate(tensors["index"].numpy().astype(np.int32), tensors["fine"])
