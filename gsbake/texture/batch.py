"""One photo's pixels as tensors, and how they are shaded.

The split sum of `gsbake.light.shade` with what is around a texel: its openness to the present light, what other texels send it, and the
light that it gives itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.light.shade import shade
from gsbake.light.tables import LightTables
from gsbake.texture.colour import decode
from gsbake.texture.metal import Evidence
from gsbake.texture.pixels import Pixels

Floats = NDArray[np.float32]

#: Columns of what is around a texel after its openness to this light and to an even one: irradiance / π from other texels, own light.
BOUNCED, GLOW = slice(2, 5), slice(5, 8)


@dataclass(frozen=True)
class Batch:
    """n pixels of one photo, as in `Pixels`, with what does not change: the `normal` (n, 3) of the mesh there, of any length."""

    texel: Tensor
    share: Tensor
    towards: Tensor
    colour: Tensor
    weight: Tensor
    block: Tensor
    normal: Tensor

    @classmethod
    def of(cls, pixels: Pixels, normal: Tensor) -> Batch:
        """The `pixels` of a photo on a mesh whose texels have the `normal` (texels, 3)."""
        texel, share = torch.as_tensor(pixels.texel), torch.as_tensor(pixels.share)
        towards, colour, weight = (torch.as_tensor(x) for x in (pixels.towards, pixels.colour, pixels.weight))
        block = torch.as_tensor(pixels.block)
        return cls(texel, share, towards, colour, weight, block, _read(normal, texel, share))

    def shade(self, values: Tensor, bend: Tensor, tables: LightTables, around: Tensor) -> Tensor:
        """Linear colours (n, 3) of the pixels when the texels have `values` (texels, 5) and their surroundings are `around` (texels, 8)."""
        g = _read(values, self.texel, self.share)
        near = _read(around, self.texel, self.share)
        return _lit(self._turned(bend), self.towards, g[:, :3], g[:, 3], g[:, 4], tables, near)

    @property
    def foremost(self) -> Tensor:
        """The texel (n,) that has most of each pixel."""
        return self.texel.gather(1, self.share.argmax(1, keepdim=True))[:, 0]

    def showing(self, asked: Tensor) -> Batch:
        """The pixels most of which is a texel that is `asked` (texels,) for."""
        keep = asked[self.foremost]
        parts = (self.texel, self.share, self.towards, self.colour, self.weight, self.block, self.normal)
        return Batch(*(x[keep] for x in parts))

    def evidence(self, bend: Tensor, tables: LightTables, around: Tensor) -> Evidence:
        """The pixels for searches over all photos; each counts for the texel that has most of it."""
        normal, near, texel = self._turned(bend), _read(around, self.texel, self.share), self.foremost

        def shaded(base: float, roughness: Floats, metallic: float) -> Floats:
            n = len(texel)
            constant = (torch.full((n, 3), base), torch.as_tensor(roughness)[texel], torch.full((n,), metallic))
            return np.asarray(_lit(normal, self.towards, *constant, tables, near).numpy())

        return Evidence(texel.numpy(), decode(self.colour.numpy()), self.weight.numpy(), self.block.numpy(), shaded)

    def _turned(self, bend: Tensor) -> Tensor:
        """Normals (n, 3) of the pixels, of any length, when those of the texels have the `bend` (texels, 3)."""
        return self.normal + _read(bend, self.texel, self.share)


def _lit(normal: Tensor, towards: Tensor, albedo: Tensor, roughness: Tensor, metallic: Tensor, tables: LightTables, near: Tensor) -> Tensor:
    """`shade` with the surroundings `near` (n, 8), see `BOUNCED` and `GLOW`."""
    direct = shade(normal, towards, albedo, roughness, metallic, tables, near[:, 1], near[:, 0])
    return direct + (1 - metallic)[:, None] * albedo * near[:, BOUNCED] + near[:, GLOW]


def _read(values: Tensor, texel: Tensor, share: Tensor) -> Tensor:
    """`values` (texels, c) read bilinearly at the four texels and shares (n, 4) of each pixel: (n, c)."""
    first, *others = (values[texel[:, k]] * share[:, k, None] for k in range(4))
    return sum(others, first)
