"""What the material fit reads and returns: the texels of a surface with their geometry and light transport, and the fitted materials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gsbake.materials.bilateral import Neighbourhoods
from gsbake.materials.light_intensity import LightAdjustment
from gsbake.materials.photo_batch import PhotoBatch
from gsbake.materials.pixels import Pixels
from gsbake.shading.environment import EnvironmentLight
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Fitted:
    """Result of a fit.

    `values` (n, 5): linear base colour, roughness, metallic of each texel; `normal_offset` (n, 3) to be added to its unit normal; `weight`
    (n,) of all pixels that show it; `emission` (n, 3) its emitted radiance; the `light` in the mesh's frame; `held_out_psnr` in dB over the
    pixels of held-out photos (None without any), `held_out_loss` their mean robust error; the number of `emissive_regions`;
    `light_adjustments`, one per search for the light's intensity.
    """

    values: Floats
    normal_offset: Floats
    weight: Floats
    emission: Floats
    light: EnvironmentLight
    held_out_psnr: float | None
    held_out_loss: float | None
    emissive_regions: int
    light_adjustments: tuple[LightAdjustment, ...]


def validation_error(fitted: Fitted) -> float:
    """The mean robust error on validation photos; 0 without any."""
    return fitted.held_out_loss or 0.0


class Transport(Protocol):
    """Visibility and indirect light of the texels; see `gsbake.materials.visibility.Visibility`."""

    def visible_share(self, radiance: NDArray[Any]) -> Floats:
        """Unoccluded share (n,) of the irradiance by luminance under the cube map `radiance`."""

    def indirect_irradiance(self, irradiance: NDArray[Any], reflectance: NDArray[Any]) -> Floats:
        """Indirect irradiance / π (n, 3) of texels with `reflectance` (n, 3) under direct `irradiance` / π (n, 3)."""


@dataclass(frozen=True)
class FitSurface:
    """The n texels of a texture with their geometry.

    `position`, unit `normal` (n, 3) in the mesh's frame; `pairs` (m, 2) neighbouring texels, shuffled as `gsbake.materials.adjacency` does;
    `occlusion` (n,) ambient occlusion, 1 = open; `base_color` (n, 3) the initial linear base colour. With `transport` shadows follow the
    light, with `indirect` texels light each other as well.
    """

    texels: Texels
    position: NDArray[Any]
    pairs: NDArray[np.int64]
    normal: NDArray[Any]
    occlusion: NDArray[Any]
    base_color: NDArray[Any]
    transport: Transport | None = None
    indirect: bool = True

    @cached_property
    def neighbourhoods(self) -> Neighbourhoods:
        """The neighbourhoods of texels that decide together; kept, as all trials on a level use the same wide one."""
        return Neighbourhoods(self.texels, self.pairs, self.base_color)

    def batches(self, photos: list[Pixels]) -> list[PhotoBatch]:
        """The `photos` that show something as the kernels read them; kept, as all fits to them and all searches use the same."""
        if id(photos) not in self._batches:
            normal = np.ascontiguousarray(self.normal, np.float32)
            self._batches[id(photos)] = photos, [PhotoBatch.of(pixels, normal) for pixels in photos if len(pixels)]
        return self._batches[id(photos)][1]

    @cached_property
    def _batches(self) -> dict[int, tuple[list[Pixels], list[PhotoBatch]]]:
        """By the identity of the list of photos, which is kept as well, so that no other list gets its identity."""
        return {}
