"""Reference implementation of a step of the material fit in PyTorch: shading and loss of one photo's pixels, and the priors.

The split sum (`shading.split_sum`) with the light transport of each texel: visibility of the present light, indirect light and emission.
The cosine lobe of specular reflection sees what the diffuse term does. Of the prefiltered lobe, what ambient occlusion blocks has the mean
radiance of what blocks it, which indirect light tells; where a pixel's reflected ray was traced and meets the object, the radiance of the
texel that it hits replaces the environment: its diffuse radiosity, its emission, and the environment that it reflects itself.
`fit_kernel` computes the same with its gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsbake.imaging.srgb_torch import linear_to_srgb
from gsbake.materials.linear_shading import Records
from gsbake.materials.photo import Photo
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


class Transport(NamedTuple):
    """Light transport of n texels or pixels, fields as in `fit_kernel.TRANSPORT`."""

    visibility: Tensor
    occlusion: Tensor
    indirect: Tensor
    emission: Tensor
    diffuse: Tensor
    metal_colour: Tensor
    roughness: Tensor
    normal: Tensor
    metallic: Tensor

    @classmethod
    def of(cls, records: Records) -> Transport:
        """The fields of `records` (n,)."""
        return cls(*(torch.as_tensor(np.ascontiguousarray(records[name])) for name in cls._fields))

    def rows(self, index: Tensor) -> Transport:
        """Those of some texels."""
        return Transport(*(field[index] for field in self))

    def interpolated(self, texel: Tensor, bilinear: Tensor) -> Transport:
        """Those at pixels with the taps `texel` (n, 4) and weights `bilinear` (n, 4)."""
        columns = (field if field.ndim == 2 else field[:, None] for field in self)
        found = (_interpolate(column, texel, bilinear) for column in columns)
        return Transport(*(column if field.ndim == 2 else column[:, 0] for column, field in zip(found, self, strict=True)))


@dataclass(frozen=True)
class Batch:
    """The n pixels of one photo as tensors, fields as in `Photo`."""

    texel: Tensor
    bilinear: Tensor
    view: Tensor
    colour: Tensor
    weight: Tensor
    normal: Tensor
    reflected: Tensor

    @classmethod
    def of(cls, photo: Photo) -> Batch:
        """The pixels of a `photo`."""
        parts = photo.bilinear, photo.view, photo.colour, photo.weight, photo.normal
        return cls(torch.as_tensor(photo.texel).long(), *map(torch.as_tensor, parts), torch.as_tensor(photo.reflected).long())

    def shade(self, values: Tensor, normal_offset: Tensor, tables: LightTables, transport: Transport) -> Tensor:
        """Linear colours (n, 3) of the pixels for texels with material `values` (texels, 5) and light `transport`."""
        metal = values[:, 4:]
        parameters = torch.cat([(1 - metal) * values[:, :3], metal * values[:, :3], values[:, 3:]], 1)
        g = _interpolate(parameters, self.texel, self.bilinear)
        albedo, metal_colour, roughness, metallic = g[:, :3], g[:, 3:6], g[:, 6], g[:, 7]
        surface, at = unit(self._normals(normal_offset)), transport.interpolated(self.texel, self.bilinear)
        split = brdf.split_sum(soft_cosine((surface * self.view).sum(1)), roughness)
        diffuse = at.visibility[:, None] * tables.diffuse(surface) + at.indirect
        near = self._near_light(surface, roughness.detach(), split, tables, at, transport)
        light = near + split.share[:, None] * (diffuse - near)
        below = albedo * (1 - split.dielectric[:, None]) * diffuse
        return below + light * reflectance(split, metal_colour, metallic) + at.emission

    def _near_light(
        self, surface: Tensor, roughness: Tensor, split: brdf.SplitSum, tables: LightTables, at: Transport, texels: Transport
    ) -> Tensor:
        """Light (n, 3) in the prefiltered lobe of unit normals: environment, object around, and what traced rays meet of the `texels`.
        Gradients go through the environment alone."""
        ambient = specular_occlusion(surface, self.view, roughness, at.occlusion)
        around = ((1 - ambient) / (1 - at.occlusion).clamp_min(MIN_BLOCKED))[:, None] * at.indirect
        environment = prefiltered_light(surface, self.view, split, tables)
        if not len(self.reflected):
            return ambient[:, None] * environment + around
        mirror, blocked = mirror_weight(roughness)[:, None], self.reflected >= 0
        rows = torch.nonzero(blocked)[:, 0]
        facing = surface.detach()[rows]
        ray = 2 * (facing * self.view[rows]).sum(1, keepdim=True) * facing - self.view[rows]
        met = torch.zeros_like(around).index_copy(0, rows, reflected_radiance(texels.rows(self.reflected[rows]), ray, tables))
        open_share = torch.where(blocked[:, None], 0.0, mirror) + (1 - mirror) * ambient[:, None]
        return open_share * environment + (1 - mirror) * around + mirror * met

    def _normals(self, normal_offset: Tensor) -> Tensor:
        """Shading normals (n, 3) of the pixels, of any length, with the texels' `normal_offset` (texels, 3)."""
        return self.normal + _interpolate(normal_offset, self.texel, self.bilinear)


@torch.no_grad()
def reflected_radiance(met: Transport, ray: Tensor, tables: LightTables) -> Tensor:
    """Radiance (k, 3) that surfaces with light transport `met` (k,) send against the unit `ray` (k, 3) that meets each.

    Of what blocks their specular lobe the mean radiance counts, which their indirect light tells.
    """
    split = brdf.split_sum(soft_cosine(-(met.normal * ray).sum(1)), met.roughness)
    visible = specular_occlusion(met.normal, -ray, met.roughness, met.occlusion)
    blocked = ((1 - visible) / (1 - met.occlusion).clamp_min(MIN_BLOCKED))[:, None] * met.indirect
    light = visible[:, None] * specular_light(met.normal, -ray, split, tables, tables.diffuse(met.normal)) + blocked
    specular = light * reflectance(split, met.metal_colour, met.metallic)
    return (1 - split.dielectric[:, None]) * met.diffuse + met.emission + specular


def _interpolate(values: Tensor, texel: Tensor, bilinear: Tensor) -> Tensor:
    """`values` (texels, c) at pixels with the taps `texel` (n, 4) and weights `bilinear` (n, 4): (n, c)."""
    first, *others = (values[texel[:, k]] * bilinear[:, k, None] for k in range(4))
    return sum(others, first)


def photo_loss(
    batch: Batch, values: Tensor, normal_offset: Tensor, tables: LightTables, transport: Transport, residual_weight: float, robust: float
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
