"""What couplings ask of a field; every continuous field answers it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from gsbake.surfels.model import Surfels


class CoupledField(Protocol):
    """A field over the box `lower`..`upper` (3,) with the profile's section [field] as `settings`.

    `pixel_tables` keeps the pixels that rays are drawn from, by photo and width.
    """

    settings: Any
    lower: Tensor
    upper: Tensor
    pixel_tables: dict[tuple[str, int], Any]

    @property
    def cell(self) -> float:
        """Size of the finest cell (unit frame)."""

    @property
    def radiance(self) -> Callable[[Tensor, Tensor, Tensor], Tensor] | None:
        """sRGB (n, 3) of the field's own at points (n, 3) with unit normals (n, 3), seen along unit directions (n, 3); None without."""

    def value(self, points: Tensor, /) -> Tensor:
        """Signed distance (n,) at points (n, 3)."""

    def evaluate(self, points: Tensor, /) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3) at points (n, 3)."""

    def at_surfels(self, surfels: Surfels, /) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3) at the surfels' centres."""

    def sharpness(self, share: float, /) -> Tensor:
        """Sharpness γ of marched rays at this share of the run."""
