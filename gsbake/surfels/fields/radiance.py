"""Colours of a marched field: a hash grid of features and a small network that also reads normal and direction (NeuS, VolSDF).

The direction enters reflected at the normal as well (Verbin et al., *Ref-NeRF*, CVPR 2022), so that mirror images are a function of few
inputs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.surfels.fields.heads import Network
from gsbake.surfels.fields.interpolation import interpolate
from gsbake.surfels.fields.levels import DENSE, HASHED, Level, Levels

#: Cells per axis of the levels, features per level, largest number of rows of a level.
CELLS, FEATURES, MAX_ROWS = (8, 16, 32, 64, 128), 2, 1 << 15
#: Width of the network, and learning rates of table and network.
WIDTH, TABLE_RATE, NETWORK_RATE = 32, 1e-2, 2e-3


class Radiance:
    """sRGB in 0..1 at points, seen along directions."""

    def __init__(self, lower: NDArray[np.float32], upper: NDArray[np.float32], seed: int) -> None:
        """Grey everywhere in the box `lower`..`upper` (3,)."""
        generator = torch.Generator().manual_seed(seed)
        sizes = [n + 1 for n in CELLS]
        modes = [DENSE if n**3 <= MAX_ROWS else HASHED for n in sizes]
        levels = [Level((n, n, n), mode, n**3 if mode == DENSE else MAX_ROWS) for n, mode in zip(sizes, modes, strict=True)]
        self.levels = Levels(lower, upper, tuple(levels))
        self.table = 1e-2 * torch.randn(self.levels.rows, FEATURES, generator=generator)
        self.network = Network(len(CELLS) * FEATURES + 9, WIDTH, 1, 3, generator)

    def __call__(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """Colours (n, 3) at points (n, 3) with unit normals (n, 3), seen along unit directions (n, 3)."""
        features, _ = interpolate(points, self.table, self.levels)
        reflected = directions - 2 * (directions * normals).sum(1, keepdim=True) * normals
        return torch.sigmoid(self.network(torch.cat([10 * features, normals, directions, reflected], 1)))

    def parameters(self) -> dict[str, Tensor]:
        """Table and network."""
        return {"table": self.table} | self.network.weights

    def rates(self) -> dict[str, float]:
        """Per tensor."""
        return {k: TABLE_RATE if k == "table" else NETWORK_RATE for k in self.parameters()}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `parameters` returned."""
        self.table = tensors["table"].contiguous()
        self.network.weights = {k: tensors[k].contiguous() for k in self.network.weights}
