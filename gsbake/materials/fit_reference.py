"""Reference implementation of a step of the material fit in PyTorch: shading and loss of one photo's pixels, and the priors.

The split sum (`shading.split_sum`) with the light transport of each texel: visibility of the present light, indirect light and emission.
The cosine lobe of specular reflection sees what the diffuse term does. Of the prefiltered lobe, what ambient occlusion blocks has the mean
radiance of what blocks it, which indirect light tells; where a pixel's reflected ray was traced and meets the object, the radiance of the
texel that it hits replaces the environment: its diffuse radiosity, its emission, and the environment that it reflects itself.
`fit_kernel` computes the same with its gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbake.imaging.srgb_torch import linear_to_srgb
from gsbake.materials.photo_batch import (
    DIFFUSE,
    EMISSION,
    INDIRECT,
    LOCAL,
    METAL_COLOUR,
    METALLIC,
    NORMAL,
    OCCLUSION,
    ROUGHNESS,
    VISIBILITY,
)
from gsbake.materials.pixels import Pixels
from gsbake.shading import brdf
from gsbake.shading.light_tables import LightTables
from gsbake.shading.reflection_kernel import MIN_BLOCKED
from gsbake.shading.split_sum import (
    mirror_weight,
    prefiltered_light,
    reflectance,
    soft_cosine,
    specular_light,
    specular_occlusion,
    unit,
)


@dataclass(frozen=True)
class PixelTransport:
    """Light transport at n pixels: `local` (n, 8), the columns up to `EMISSION`; where reflections were traced, which are `blocked` (n,)
    by the object, the `rows` (k,) of these and the transport `met` (k, TRANSPORT) of the texels that their reflected rays meet."""

    local: Tensor
    blocked: Tensor | None
    rows: Tensor | None
    met: Tensor | None


@dataclass(frozen=True)
class Batch:
    """The n pixels of one photo as tensors, fields as in `Pixels`, with the mesh's `normal` (n, 3) there, of any length."""

    texel: Tensor
    bilinear: Tensor
    view: Tensor
    colour: Tensor
    weight: Tensor
    normal: Tensor
    reflected_texel: Tensor | None

    @classmethod
    def of(cls, pixels: Pixels, normal: Tensor) -> Batch:
        """The `pixels` of a photo on a mesh whose texels have the `normal` (texels, 3)."""
        texel, bilinear = torch.as_tensor(pixels.texel), torch.as_tensor(pixels.bilinear)
        view, colour, weight = (torch.as_tensor(x) for x in (pixels.view, pixels.colour, pixels.weight))
        reflected = None if pixels.reflected_texel is None else torch.as_tensor(pixels.reflected_texel)
        return cls(texel, bilinear, view, colour, weight, _interpolate(normal, texel, bilinear), reflected)

    def shade(self, values: Tensor, normal_offset: Tensor, tables: LightTables, transport: Tensor) -> Tensor:
        """Linear colours (n, 3) of the pixels for texels with material `values` (texels, 5) and light `transport` (texels, TRANSPORT)."""
        metal = values[:, 4:]
        parameters = torch.cat([(1 - metal) * values[:, :3], metal * values[:, :3], values[:, 3:]], 1)
        g = _interpolate(parameters, self.texel, self.bilinear)
        albedo, metal_colour, roughness, metallic = g[:, :3], g[:, 3:6], g[:, 6], g[:, 7]
        surface, at = unit(self._normals(normal_offset)), self._transport(transport)
        split = brdf.split_sum(soft_cosine((surface * self.view).sum(1)), roughness)
        diffuse = at.local[:, VISIBILITY, None] * tables.diffuse(surface) + at.local[:, INDIRECT]
        near = self._near_light(surface, roughness.detach(), split, tables, at)
        light = near + split.share[:, None] * (diffuse - near)
        below = albedo * (1 - split.dielectric[:, None]) * diffuse
        return below + light * reflectance(split, metal_colour, metallic) + at.local[:, EMISSION]

    def _near_light(
        self, surface: Tensor, roughness: Tensor, split: brdf.SplitSum, tables: LightTables, transport: PixelTransport
    ) -> Tensor:
        """Light (n, 3) in the prefiltered lobe of unit normals: environment, object around, and what traced rays meet. Gradients go through
        the environment alone."""
        occlusion = transport.local[:, OCCLUSION]
        ambient = specular_occlusion(surface, self.view, roughness, occlusion)
        around = ((1 - ambient) / (1 - occlusion).clamp_min(MIN_BLOCKED))[:, None] * transport.local[:, INDIRECT]
        environment = prefiltered_light(surface, self.view, split, tables)
        if transport.blocked is None or transport.rows is None or transport.met is None:
            return ambient[:, None] * environment + around
        mirror = mirror_weight(roughness)[:, None]
        at, facing = transport.rows, surface.detach()[transport.rows]
        ray = 2 * (facing * self.view[at]).sum(1, keepdim=True) * facing - self.view[at]
        met = torch.zeros_like(around).index_copy(0, at, reflected_radiance(transport.met, ray, tables))
        open_share = torch.where(transport.blocked[:, None], 0.0, mirror) + (1 - mirror) * ambient[:, None]
        return open_share * environment + (1 - mirror) * around + mirror * met

    def _normals(self, normal_offset: Tensor) -> Tensor:
        """Shading normals (n, 3) of the pixels, of any length, with the texels' `normal_offset` (texels, 3)."""
        return self.normal + _interpolate(normal_offset, self.texel, self.bilinear)

    def _transport(self, transport: Tensor) -> PixelTransport:
        """Light transport at each pixel from that of the texels (texels, TRANSPORT)."""
        local = _interpolate(transport[:, LOCAL], self.texel, self.bilinear)
        if self.reflected_texel is None:
            return PixelTransport(local, None, None, None)
        blocked = self.reflected_texel >= 0
        rows = torch.nonzero(blocked)[:, 0]
        return PixelTransport(local, blocked, rows, transport[self.reflected_texel[rows]])


@torch.no_grad()
def reflected_radiance(met: Tensor, ray: Tensor, tables: LightTables) -> Tensor:
    """Radiance (k, 3) that surfaces with light transport `met` (k, TRANSPORT) send against the unit `ray` (k, 3) that meets each.

    Of what blocks their specular lobe the mean radiance counts, which their indirect light tells.
    """
    normal, roughness, occlusion = met[:, NORMAL], met[:, ROUGHNESS], met[:, OCCLUSION]
    split = brdf.split_sum(soft_cosine(-(normal * ray).sum(1)), roughness)
    visible = specular_occlusion(normal, -ray, roughness, occlusion)
    blocked = ((1 - visible) / (1 - occlusion).clamp_min(MIN_BLOCKED))[:, None] * met[:, INDIRECT]
    light = visible[:, None] * specular_light(normal, -ray, split, tables, tables.diffuse(normal)) + blocked
    specular = light * reflectance(split, met[:, METAL_COLOUR], met[:, METALLIC])
    return (1 - split.dielectric[:, None]) * met[:, DIFFUSE] + met[:, EMISSION] + specular


def _interpolate(values: Tensor, texel: Tensor, bilinear: Tensor) -> Tensor:
    """`values` (texels, c) at pixels with the taps `texel` (n, 4) and weights `bilinear` (n, 4): (n, c)."""
    first, *others = (values[texel[:, k]] * bilinear[:, k, None] for k in range(4))
    return sum(others, first)


def photo_loss(
    batch: Batch, values: Tensor, normal_offset: Tensor, tables: LightTables, transport: Tensor, residual_weight: float, robust: float
) -> Tensor:
    """Mean weighted pseudo-Huber error of the pixels in sRGB, for texels with material `values` (texels, 5)."""
    # Clamped: a reflection brighter than white that the photo does not show has no gradient; it is misplaced rather than too bright.
    error = linear_to_srgb(batch.shade(values, normal_offset, tables, transport).clamp(0, 1)) - batch.colour
    return (residual_weight * ((error.square() + robust**2).sqrt() - robust).mean(1) * batch.weight).mean()


def prior_loss(
    values: Tensor,
    normal_offset: Tensor,
    pairs: Tensor,
    smoothness: Tensor,
    mean_weight: Tensor,
    offset_weight: float,
    common: Tensor,
    common_weight: Tensor,
) -> Tensor:
    """The priors, summed over texels: |Δ| of material `values` (n, 5) and Δ² of `normal_offset` (n, 3) between neighbouring `pairs` (m, 2)
    with the weights `smoothness` (8,); `mean_weight` (5,) times the values, of base colour the diffuse part; squared normal offset; squared
    distance of sRGB base colour and roughness to the `common` materials (n, 4) with half of `common_weight` (4,)."""
    change = values[pairs[:, 0]] - values[pairs[:, 1]]
    difference = normal_offset[pairs[:, 0]] - normal_offset[pairs[:, 1]]
    distance = torch.cat([linear_to_srgb(values[:, :3]), values[:, 3:4]], 1) - common
    return (
        (change.abs() @ smoothness[:5]).sum()
        + (difference.square() @ smoothness[5:]).sum()
        + (values[:, :3] * (1 - values[:, 4:].detach()) @ mean_weight[:3] + values[:, 3:] @ mean_weight[3:]).sum()
        + offset_weight * normal_offset.square().sum()
        + 0.5 * (distance.square() @ common_weight).sum()
    )
