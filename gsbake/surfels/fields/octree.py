"""Distances at the corners of an octree that is fine where the surface is curved, as GS-Octree (Li et al. 2024) keeps them.

Each level adds, at the corners of the cells that were divided, the difference to the interpolation of the levels above (a hierarchical
basis: Yserentant 1986). A corner on the border between divided and undivided cells is held at no difference, so the field is continuous
and dividing a cell changes nothing until its corners are trained.
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
from gsbake.surfels.fields.levels import CORNERS, DENSE, Level, Levels

Mask = NDArray[np.bool_]
#: Cells per axis of the root level.
ROOT_CELLS = 16
#: A cell near the surface is divided where a level more changes its distance by this share of the cell.
MIN_DIFFERENCE = 0.02
#: A cell near the surface is divided in training where the gradient turns by this much (radians) between its corners.
MIN_TURN = 0.25
#: Shares of the run at which cells are divided.
DIVISIONS = (0.2, 0.45)
#: Rate in cells of the finest level per step.
RATE_CELLS = 0.05


def corners_of(divided: Mask) -> Mask:
    """Corners (2n+1)³ of the halved cells of `divided` (n, n, n) that all adjacent halved cells share: what is free to move."""
    fine = divided.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    padded = np.pad(fine, 1, mode="edge")  # the box's border is no border between levels
    free = np.ones(tuple(n + 1 for n in fine.shape), bool)
    for a in (0, 1):
        for b in (0, 1):
            for c in (0, 1):
                free &= padded[a : a + free.shape[0], b : b + free.shape[1], c : c + free.shape[2]]
    return free


class OctreeField(ContinuousField):
    """Hierarchical distances at corners."""

    name = "octree"

    def start(self, known: Known, seed: int) -> None:
        """Divide where the known distance differs from the coarser interpolation, down to the finest level."""
        centre, edge = (self.lower + self.upper) / 2, float((self.upper - self.lower).max())
        self.lower, self.upper = centre - edge / 2, centre + edge / 2
        self.depth = max(0, round(np.log2(max(self.settings.resolution, ROOT_CELLS) / ROOT_CELLS)))
        self.divisions = 0
        n = ROOT_CELLS + 1
        corners = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
        root = torch.from_numpy(known(self._positions(corners, ROOT_CELLS)))
        self._build([], [root])
        self.divided: list[Mask] = []
        for level in range(self.depth):
            cells = ROOT_CELLS << level
            parent = np.ones((cells,) * 3, bool) if level == 0 else self.divided[-1].repeat(2, 0).repeat(2, 1).repeat(2, 2)
            chosen = np.argwhere(parent)
            middle = self._positions(chosen + 0.5, cells)
            f = self._values(middle)
            size = edge / cells
            near = np.abs(f) < 1.2 * size
            chosen, middle, f = chosen[near], middle[near], f[near]
            # the last levels are divided wherever the known distance asks for it; the first ones wherever the surface is
            keep = np.abs(known(middle) - f) > MIN_DIFFERENCE * size if level >= 2 else np.ones(len(chosen), bool)
            divided = np.zeros((cells,) * 3, bool)
            divided[tuple(chosen[keep].T)] = True
            self.divided.append(_closed(divided, parent))
            self._add_level(known)

    def _positions(self, corners: NDArray[np.floating] | NDArray[np.integer], cells: int) -> NDArray[np.float64]:
        edge = float(self.upper[0] - self.lower[0])
        return self.lower.numpy().astype(float) + edge / cells * corners

    def _values(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        with torch.no_grad():
            x = torch.from_numpy(points.astype(np.float32))
            return np.asarray(self.value(x).numpy()) if len(x) else np.zeros(0, np.float32)

    def _build(self, divided: list[Mask], values: list[Tensor]) -> None:
        """Index tables of the levels, and one tensor of all corners' values."""
        levels = [Level((ROOT_CELLS + 1,) * 3, DENSE, (ROOT_CELLS + 1) ** 3)]
        for mask in divided:
            free = corners_of(mask)
            index = np.full(free.shape, -1, np.int32)
            index[free] = np.arange(int(free.sum()), dtype=np.int32)
            levels.append(Level((free.shape[0], free.shape[1], free.shape[2]), CORNERS, int(free.sum()), index))
        self.table = torch.cat(values)[:, None].contiguous()
        self.levels = Levels(self.lower.numpy(), self.upper.numpy(), tuple(levels))
        self._at = None

    def _split_values(self) -> list[Tensor]:
        return list(self.table[:, 0].split([level.rows for level in self.levels.levels]))

    def _add_level(self, known: Known | None) -> None:
        """Give the last of `divided` its corners, with the difference to the known distance or without one."""
        mask = self.divided[-1]
        free = np.argwhere(corners_of(mask))
        values = torch.zeros(len(free))
        if known is not None and len(free):
            points = self._positions(free, 2 * mask.shape[0])
            values = torch.from_numpy(known(points) - self._values(points))
        self._build(self.divided, [*self._split_values(), values])

    def advance(self, share: float) -> bool:
        """Divide cells near the surface where the gradient turns within them; what was divided stays so, with its values."""
        due = sum(share >= at for at in DIVISIONS)
        if due <= self.divisions or not self.depth:
            return False
        self.divisions = due
        values, before = self._split_values(), [level.index for level in self.levels.levels]
        changed = False
        for level in range(self.depth):
            cells = ROOT_CELLS << level
            parent = np.ones((cells,) * 3, bool) if level == 0 else self.divided[level - 1].repeat(2, 0).repeat(2, 1).repeat(2, 2)
            candidates = np.argwhere(parent & ~self.divided[level])
            wanted = self.divided[level].copy()
            if len(candidates):
                wanted[tuple(candidates[self._turns(candidates, cells)].T)] = True
            wanted = _closed(wanted, parent)
            if not np.array_equal(wanted, self.divided[level]):
                changed = True
                self.divided[level] = wanted
                free, old = corners_of(wanted), before[level + 1]
                assert old is not None
                rows = old[free]
                fresh = torch.zeros(int(free.sum()))
                fresh[torch.from_numpy(rows >= 0)] = values[level + 1][torch.from_numpy(rows[rows >= 0].astype(np.int64))]
                values[level + 1] = fresh
        if changed:
            self._build(self.divided, values)
        return changed

    def _turns(self, cells_at: NDArray[np.int64], cells: int) -> Mask:
        """Which cells (n, 3) are near the surface and have gradients that differ between opposite corners."""
        size = float(self.upper[0] - self.lower[0]) / cells
        near = np.abs(self._values(self._positions(cells_at + 0.5, cells))) < 1.2 * size
        out = np.zeros(len(cells_at), bool)
        if near.any():
            with torch.no_grad():
                ends = [torch.from_numpy(self._positions(cells_at[near] + a, cells).astype(np.float32)) for a in (0.05, 0.95)]
                g = [torch.nn.functional.normalize(self.gradient(x), dim=1, eps=1e-6) for x in ends]
                out[near] = ((g[0] * g[1]).sum(1) < np.cos(MIN_TURN)).numpy()
        return out

    def _inside(self, points: Tensor) -> tuple[Tensor, Tensor]:
        f, g = interpolate(points, self.table, self.levels)
        return f.sum(1), g.sum(2)

    def own_parameters(self) -> dict[str, Tensor]:
        """Values at the corners."""
        return {"table": self.table}

    def own_rates(self) -> dict[str, float]:
        """Finest cells per step."""
        return {"table": self.settings.rate * RATE_CELLS * self.cell}

    def own_tensors(self) -> dict[str, Tensor]:
        """Box, values and divided cells."""
        own = {"lower": self.lower, "upper": self.upper, "table": self.table, "numbers": torch.tensor([self.depth, self.divisions])}
        return own | {f"divided.{i}": torch.from_numpy(mask) for i, mask in enumerate(self.divided)}

    def load_own(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `own_tensors` returned."""
        self.lower, self.upper = tensors["lower"], tensors["upper"]
        self.depth, self.divisions = (int(n) for n in tensors["numbers"])
        self.divided = [tensors[f"divided.{i}"].numpy().astype(bool) for i in range(self.depth)]
        self._build(self.divided, [tensors["table"][:, 0]])


def _closed(divided: Mask, parent: Mask) -> Mask:
    """Grow by one cell within the divided parents, so that a cell that is chosen has corners that are free."""
    padded = np.pad(divided, 1)
    grown = np.zeros_like(divided)
    n = divided.shape[0]
    for a in range(3):
        for b in range(3):
            for c in range(3):
                grown |= padded[a : a + n, b : b + n, c : c + n]
    return np.asarray(grown & parent)
