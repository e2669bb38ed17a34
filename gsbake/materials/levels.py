"""Two resolutions of the material fit: the fit texture, and one of half its edge on which starts are compared and searches are made.

Starts are compared on the coarse level, with a quarter of the texels and of the pixels, and the fine level continues from the best of them.
Visibility and indirect light vary slowly over the surface: they are traced on
the coarse level and interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.materials.adjacency import neighbours
from gsbake.materials.fit_surface import FitSurface, Transport
from gsbake.materials.pixels import Pixels
from gsbake.texturing.resampling import CoarseTexture

Floats = NDArray[np.float32]

#: The coarse level keeps every so many pixels of a photo: as its texels cover as many.
PIXEL_STEP = 4


@dataclass(frozen=True)
class FitLevel:
    """One resolution: the texels, and the pixels of the photos to fit and of the validation photos."""

    surface: FitSurface
    fitted: list[Pixels]
    held_out: list[Pixels]


@dataclass(frozen=True)
class InterpolatedTransport:
    """Visibility and indirect light of the fine texels of `texture`, computed by `coarse` on its coarse texels."""

    coarse: Transport
    texture: CoarseTexture

    def visible_share(self, radiance: NDArray[Any]) -> Floats:
        """See `Visibility.visible_share`."""
        return self.texture.up(self.coarse.visible_share(radiance)[:, None])[:, 0]

    def indirect_irradiance(self, irradiance: NDArray[Any], reflectance: NDArray[Any]) -> Floats:
        """See `Visibility.indirect_irradiance`."""
        return self.texture.up(self.coarse.indirect_irradiance(self.texture.down(irradiance), self.texture.down(reflectance)))


def coarse_surface(surface: FitSurface, texture: CoarseTexture) -> FitSurface:
    """The texels of `surface` averaged onto the coarse ones of `texture`, without light transport."""
    normal, occlusion, base, position = (
        texture.down(x) for x in (surface.normal, surface.occlusion[:, None], surface.base_color, surface.position)
    )
    pairs = neighbours(texture.texels, position, normal)
    return replace(
        surface, texels=texture.texels, position=position, pairs=pairs, normal=normal, occlusion=occlusion[:, 0], base_color=base,
        transport=None,
    )  # fmt: skip


def coarse_pixels(pixels: Pixels, texture: CoarseTexture) -> Pixels:
    """Every `PIXEL_STEP`-th of the `pixels`, reading the coarse texels of `texture` that contain their fine ones."""
    chosen = pixels.every(PIXEL_STEP)
    parent = coarse_texels(texture)
    texel = parent[chosen.texel]
    bilinear = np.where(texel >= 0, chosen.bilinear, 0).astype(np.float32)
    total = bilinear.sum(1)
    reflected = chosen.reflected_texel
    if reflected is not None:
        reflected = np.where(reflected >= 0, parent[reflected], -1)
    share = bilinear / np.maximum(total, 1e-6)[:, None]
    return replace(chosen, texel=np.maximum(texel, 0), bilinear=share, reflected_texel=reflected, weight=chosen.weight * (total > 0))


def coarse_texels(texture: CoarseTexture) -> NDArray[np.int64]:
    """The coarse texel (n,) that contains each fine one, -1: none."""
    factor = texture.fine.size // texture.texels.size
    row, column = np.divmod(texture.fine.index, texture.fine.size)
    return texture.texels.lookup[row // factor * texture.texels.size + column // factor]
