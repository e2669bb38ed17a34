"""Differentiable shading of one photo's pixels.

The split sum (`shading.split_sum`) with the light transport of each texel: visibility of the present light, indirect light and emission.
Where a pixel's reflected ray was traced and meets the object, the outgoing radiance of the texel that it hits replaces the environment.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.imaging.srgb import decode
from gsbake.materials.metallic import PhotoSamples
from gsbake.materials.pixels import Pixels
from gsbake.shading.light_tables import LightTables
from gsbake.shading.split_sum import mirror_reflection, shade, traced_specular_visibility

Floats = NDArray[np.float32]

#: Columns of a texel's light transport: visibility (0..1) of the present light and, for specular reflection, of uniform light (ambient
#: occlusion); indirect irradiance / π; emission; outgoing radiance, which reflections of the object show.
VISIBILITY, OCCLUSION, INDIRECT, EMISSION, OUTGOING = 0, 1, slice(2, 5), slice(5, 8), slice(8, 11)
TRANSPORT_CHANNELS = 11


@dataclass(frozen=True)
class PixelTransport:
    """Light transport at n pixels: `local` (n, 8), the columns up to `EMISSION`; where reflections were traced, which are `blocked` (n,)
    by the object, the `rows` (k,) of these and the `outgoing` radiance (k, 3) along their reflected rays."""

    local: Tensor
    blocked: Tensor | None
    rows: Tensor | None
    outgoing: Tensor | None


@dataclass(frozen=True)
class Batch:
    """The n pixels of one photo as tensors, fields as in `Pixels`, with the mesh's `normal` (n, 3) there, of any length."""

    texel: Tensor
    bilinear: Tensor
    view: Tensor
    colour: Tensor
    weight: Tensor
    block: Tensor
    normal: Tensor
    reflected_texel: Tensor | None

    @classmethod
    def of(cls, pixels: Pixels, normal: Tensor) -> Batch:
        """The `pixels` of a photo on a mesh whose texels have the `normal` (texels, 3)."""
        texel, bilinear = torch.as_tensor(pixels.texel), torch.as_tensor(pixels.bilinear)
        view, colour, weight = (torch.as_tensor(x) for x in (pixels.view, pixels.colour, pixels.weight))
        block = torch.as_tensor(pixels.block)
        reflected = None if pixels.reflected_texel is None else torch.as_tensor(pixels.reflected_texel)
        return cls(texel, bilinear, view, colour, weight, block, _interpolate(normal, texel, bilinear), reflected)

    def shade(self, values: Tensor, normal_offset: Tensor, tables: LightTables, transport: Tensor) -> Tensor:
        """Linear colours (n, 3) of the pixels for texels with material `values` (texels, 5) and light `transport` (texels, 11)."""
        g = _interpolate(values, self.texel, self.bilinear)
        return self._shade(self._normals(normal_offset), g[:, :3], g[:, 3], g[:, 4], tables, self._transport(transport))

    @property
    def dominant_texel(self) -> Tensor:
        """The texel (n,) with the largest bilinear weight in each pixel."""
        return self.texel.gather(1, self.bilinear.argmax(1, keepdim=True))[:, 0]

    def select(self, chosen: Tensor) -> Batch:
        """The pixels whose dominant texel is `chosen` (texels,)."""
        keep = chosen[self.dominant_texel]
        every = {field.name: getattr(self, field.name) for field in fields(self)}
        selected: Any = {name: None if part is None else part[keep] for name, part in every.items()}
        return Batch(**selected)

    def samples(self, normal_offset: Tensor, tables: LightTables, transport: Tensor) -> PhotoSamples:
        """The pixels for searches over all photos; each counts for its dominant texel."""
        normal, pixel_transport, texel = self._normals(normal_offset), self._transport(transport), self.dominant_texel

        def shaded(base: float, roughness: Floats, metallic: float) -> Floats:
            n = len(texel)
            constant = (torch.full((n, 3), base), torch.as_tensor(roughness)[texel], torch.full((n,), metallic))
            return np.asarray(self._shade(normal, *constant, tables, pixel_transport).numpy())

        return PhotoSamples(texel.numpy(), decode(self.colour.numpy()), self.weight.numpy(), self.block.numpy(), shaded)

    def _normals(self, normal_offset: Tensor) -> Tensor:
        """Shading normals (n, 3) of the pixels, of any length, with the texels' `normal_offset` (texels, 3)."""
        return self.normal + _interpolate(normal_offset, self.texel, self.bilinear)

    def _transport(self, transport: Tensor) -> PixelTransport:
        """Light transport at each pixel from that of the texels (texels, 11)."""
        local = _interpolate(transport[:, : OUTGOING.start], self.texel, self.bilinear)
        if self.reflected_texel is None:
            return PixelTransport(local, None, None, None)
        blocked = self.reflected_texel >= 0
        rows = torch.nonzero(blocked)[:, 0]
        return PixelTransport(local, blocked, rows, transport[self.reflected_texel[rows], OUTGOING])

    def _shade(
        self, normal: Tensor, albedo: Tensor, roughness: Tensor, metallic: Tensor, tables: LightTables, transport: PixelTransport
    ) -> Tensor:
        """Linear colours (n, 3): split sum with visibility, reflections of the object, indirect diffuse light and emission."""
        local, view, blocked = transport.local, self.view, transport.blocked
        occlusion = local[:, OCCLUSION]
        visibility = None if blocked is None else traced_specular_visibility(normal, view, roughness, occlusion, blocked)
        lit = shade(normal, view, albedo, roughness, metallic, tables, occlusion, local[:, VISIBILITY], visibility)
        if transport.rows is not None and transport.outgoing is not None:
            at, outgoing = transport.rows, transport.outgoing
            lit = lit.index_add(0, at, mirror_reflection(normal[at], view[at], albedo[at], roughness[at], metallic[at], outgoing))
        return lit + (1 - metallic)[:, None] * albedo * local[:, INDIRECT] + local[:, EMISSION]


def _interpolate(values: Tensor, texel: Tensor, bilinear: Tensor) -> Tensor:
    """`values` (texels, c) at pixels with the taps `texel` (n, 4) and weights `bilinear` (n, 4): (n, c)."""
    first, *others = (values[texel[:, k]] * bilinear[:, k, None] for k in range(4))
    return sum(others, first)
