"""One photo's pixels as tensors, and how they are shaded.

The split sum (`shading.split_sum`) with what is around a texel: its openness to the present light, what other texels send it, and the
light that it gives itself. Where a pixel's mirrored view was traced and meets the object, that is what the pixel reflects.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.imaging.srgb import decode
from gsbake.materials.metallic import Evidence
from gsbake.materials.pixels import Pixels
from gsbake.shading.light_tables import LightTables
from gsbake.shading.split_sum import mirror_reflection, shade, traced_specular_visibility

Floats = NDArray[np.float32]

#: Columns of what is around a texel after its openness to this light and to an even one: irradiance / π from other texels, own light,
#: and what a mirror sees of it.
BOUNCED, GLOW, SENT = slice(2, 5), slice(5, 8), slice(8, 11)
AROUND = 11


@dataclass(frozen=True)
class Near:
    """What is around n pixels: `texels` (n, 8) their texels' `BOUNCED`, `GLOW` and openness; where reflections were traced, which are
    `blocked` (n,), the `rows` (k,) of these and the radiance `sent` (k, 3) along their mirrored view."""

    texels: Tensor
    blocked: Tensor | None
    rows: Tensor | None
    sent: Tensor | None


@dataclass(frozen=True)
class Batch:
    """n pixels of one photo, as in `Pixels`, with what does not change: the `normal` (n, 3) of the mesh there, of any length.

    `met` (n,) is None where reflections were not traced."""

    texel: Tensor
    share: Tensor
    towards: Tensor
    colour: Tensor
    weight: Tensor
    block: Tensor
    normal: Tensor
    met: Tensor | None

    @classmethod
    def of(cls, pixels: Pixels, normal: Tensor) -> Batch:
        """The `pixels` of a photo on a mesh whose texels have the `normal` (texels, 3)."""
        texel, share = torch.as_tensor(pixels.texel), torch.as_tensor(pixels.share)
        towards, colour, weight = (torch.as_tensor(x) for x in (pixels.towards, pixels.colour, pixels.weight))
        block = torch.as_tensor(pixels.block)
        met = None if pixels.met is None else torch.as_tensor(pixels.met)
        return cls(texel, share, towards, colour, weight, block, _read(normal, texel, share), met)

    def shade(self, values: Tensor, bend: Tensor, tables: LightTables, around: Tensor) -> Tensor:
        """Linear colours (n, 3) of the pixels when texels have `values` (texels, 5) and surroundings `around` (texels, 11)."""
        g = _read(values, self.texel, self.share)
        return self._lit(self._turned(bend), g[:, :3], g[:, 3], g[:, 4], tables, self._near(around))

    @property
    def foremost(self) -> Tensor:
        """The texel (n,) that has most of each pixel."""
        return self.texel.gather(1, self.share.argmax(1, keepdim=True))[:, 0]

    def showing(self, asked: Tensor) -> Batch:
        """The pixels most of which is a texel that is `asked` (texels,) for."""
        keep = asked[self.foremost]
        every = {field.name: getattr(self, field.name) for field in fields(self)}
        kept: Any = {name: None if part is None else part[keep] for name, part in every.items()}
        return Batch(**kept)

    def evidence(self, bend: Tensor, tables: LightTables, around: Tensor) -> Evidence:
        """The pixels for searches over all photos; each counts for the texel that has most of it."""
        normal, near, texel = self._turned(bend), self._near(around), self.foremost

        def shaded(base: float, roughness: Floats, metallic: float) -> Floats:
            n = len(texel)
            constant = (torch.full((n, 3), base), torch.as_tensor(roughness)[texel], torch.full((n,), metallic))
            return np.asarray(self._lit(normal, *constant, tables, near).numpy())

        return Evidence(texel.numpy(), decode(self.colour.numpy()), self.weight.numpy(), self.block.numpy(), shaded)

    def _turned(self, bend: Tensor) -> Tensor:
        """Normals (n, 3) of the pixels, of any length, when those of the texels have the `bend` (texels, 3)."""
        return self.normal + _read(bend, self.texel, self.share)

    def _near(self, around: Tensor) -> Near:
        """What is around each pixel when `around` (texels, 11) is what is around the texels."""
        texels = _read(around[:, : SENT.start], self.texel, self.share)
        if self.met is None:
            return Near(texels, None, None, None)
        blocked = self.met >= 0
        rows = torch.nonzero(blocked)[:, 0]
        return Near(texels, blocked, rows, around[self.met[rows], SENT])

    def _lit(self, normal: Tensor, albedo: Tensor, roughness: Tensor, metallic: Tensor, tables: LightTables, near: Near) -> Tensor:
        """`shade` of the pixels with their surroundings, linear colours (n, 3)."""
        texels, view = near.texels, self.towards
        openness = None if near.blocked is None else traced_specular_visibility(normal, view, roughness, texels[:, 1], near.blocked)
        lit = shade(normal, view, albedo, roughness, metallic, tables, texels[:, 1], texels[:, 0], openness)
        if near.rows is not None and near.sent is not None:
            at = near.rows
            lit = lit.index_add(0, at, mirror_reflection(normal[at], view[at], albedo[at], roughness[at], metallic[at], near.sent))
        return lit + (1 - metallic)[:, None] * albedo * texels[:, BOUNCED] + texels[:, GLOW]


def _read(values: Tensor, texel: Tensor, share: Tensor) -> Tensor:
    """`values` (texels, c) read bilinearly at the four texels and shares (n, 4) of each pixel: (n, c)."""
    first, *others = (values[texel[:, k]] * share[:, k, None] for k in range(4))
    return sum(others, first)
