"""A factorised grid: three planes and three lines of features whose products a small network reads, as the TensoSDF of GS-ROR².

V(x) = ⊕ over the three axis pairs of M^{YZ}(y, z) ∘ v^X(x) (Chen et al., *TensoRF*, ECCV 2022; Zhu et al., *GS-ROR²*, 2024): memory grows
with the square of the resolution. Planes and lines are levels with a single corner along the axes that they do not depend on.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.fields.encoded import EncodedField
from gsbake.surfels.fields.interpolation import interpolate
from gsbake.surfels.fields.levels import DENSE, Level, Levels

#: Standard deviation of the initial features around the mean of planes (0) and lines (1).
INITIAL = 0.02


class TensorField(EncodedField):
    """Planes, lines and network."""

    name = "tensor"

    def _make_encoding(self, generator: torch.Generator) -> int:
        n, rank = self.settings.resolution + 1, self.settings.rank
        planes = [Level(size, DENSE, n * n) for size in ((1, n, n), (n, 1, n), (n, n, 1))]
        lines = [Level(size, DENSE, n) for size in ((n, 1, 1), (1, n, 1), (1, 1, n))]
        self.levels = Levels(self.lower.numpy(), self.upper.numpy(), (*planes, *lines))
        self.table = INITIAL * torch.randn(3 * n * n + 3 * n, rank, generator=generator)
        self.table[3 * n * n :] += 1
        return 3 * rank

    def _encode(self, points: Tensor) -> tuple[Tensor, Tensor]:
        features, jacobian = interpolate(points, self.table, self.levels)
        half = features.shape[1] // 2
        (p, v), (dp, dv) = features.split(half, 1), jacobian.split(half, 2)
        return p * v, dp * v[:, None] + p[:, None] * dv
