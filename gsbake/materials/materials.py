"""Materials of texels as named arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Materials:
    """Materials of n texels: linear `base_color` (n, 3), `roughness` and `metallic` (n,); `normal_offset` (n, 3) to be added to the unit
    normal, and emitted radiance `emission` (n, 3), where there are such."""

    base_color: Floats
    roughness: Floats
    metallic: Floats
    normal_offset: Floats | None = None
    emission: Floats | None = None

    def __len__(self) -> int:
        return len(self.roughness)

    def of(self, texel: NDArray[np.int64] | NDArray[np.bool_]) -> Materials:
        """Base colour, roughness and metallic of some texels."""
        return Materials(self.base_color[texel], self.roughness[texel], self.metallic[texel])

    def copied(self) -> Materials:
        """A copy, which does not change with the arrays of this one."""
        return replace(self, **{name: array.copy() for name, array in vars(self).items() if array is not None})
