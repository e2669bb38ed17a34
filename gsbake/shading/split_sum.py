"""Deferred split-sum shading of G-buffers under a prefiltered environment light.

    S   = (1 − s) · L(d, ρ) + s · E(n)
    out = (1 − metallic) · (albedo · (1 − D) · E(n) + D · S) + metallic · (albedo · A + B) · S

with the directional albedos of dielectrics, D, and of conductors, F0 · A + B, at n·v and roughness (`brdf`).
(METHOD §6; Karis, *Real Shading in Unreal Engine 4*, 2013; Munkberg et al., nvdiffrec, CVPR 2022.) On the CPU in float32, forward and
backward pass are one Numba kernel each; other devices and float64 use PyTorch. Shadowing and inter-reflection enter through the occlusion
and visibility arguments only.

The light S of the specular lobe comes from the map that is prefiltered at normal incidence and from the irradiance: share s, direction d
and roughness ρ are those that imitate the lobe at n·v best (`specular_lobe`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsbake.shading import brdf
from gsbake.shading import split_sum_kernel as kernels
from gsbake.shading.light_tables import LightTables


def shade(
    normal: torch.Tensor,
    view: torch.Tensor,
    albedo: torch.Tensor,
    roughness: torch.Tensor,
    metallic: torch.Tensor,
    tables: LightTables,
    occlusion: torch.Tensor | None = None,
    diffuse_visibility: torch.Tensor | None = None,
) -> torch.Tensor:
    """Linear colours (n, 3) of n pixels.

    Parameters
    ----------
    normal: (n, 3), unit frame, any length; one shorter than .01 gets no gradient.
    view: (n, 3), unit vectors from the surface to the camera, unit frame.
    albedo: (n, 3), linear.
    roughness, metallic: (n,), 0…1; α = roughness².
    tables: the prefiltered light, in the same frame.
    occlusion: (n,), ambient occlusion, 1 = unoccluded; None is unoccluded. It scales the diffuse term and, converted to specular occlusion
    (Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014), the specular term.
    diffuse_visibility: (n,), factor of the diffuse term instead of `occlusion`: the visible share of this light's irradiance.

    Notes
    -----
    n·v is clamped smoothly to (c + √(c² + 4 m²))/2 with m = .01, which is positive and increasing, and differs from c by less than m² / c
    for c > 0. So normals that face away from the camera get a gradient too.
    """
    if occlusion is None:
        visibility_d = visibility_s = torch.ones_like(roughness)
    else:
        visibility_d = occlusion if diffuse_visibility is None else diffuse_visibility
        visibility_s = specular_occlusion(normal, view, roughness, occlusion)
    inputs = (normal, view, albedo, roughness, metallic, visibility_d, visibility_s, tables.table)
    if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in inputs):
        colour: torch.Tensor = _Kernel.apply(tables.layout, *inputs)
        return colour
    return _reference(normal, view, albedo, roughness, metallic, visibility_d, visibility_s, tables)


def reflectance(split: brdf.SplitSum, metal_colour: torch.Tensor, metallic: torch.Tensor) -> torch.Tensor:
    """Directional albedo (n, 3) of the specular lobe of materials of `metallic` (n,); `metal_colour` (n, 3) is albedo times metallic."""
    metal = metallic.unsqueeze(1)
    return metal_colour * split.scale.unsqueeze(1) + metal * split.bias.unsqueeze(1) + (1.0 - metal) * split.dielectric.unsqueeze(1)


def specular_light(
    normal: torch.Tensor, view: torch.Tensor, split: brdf.SplitSum, tables: LightTables, irradiance: torch.Tensor
) -> torch.Tensor:
    """Light (n, 3) of the environment in the specular lobe of unit normals; `irradiance` / π (n, 3) is that at the normals."""
    share = split.share.unsqueeze(1)
    return (1.0 - share) * prefiltered_light(normal, view, split, tables) + share * irradiance


def prefiltered_light(normal: torch.Tensor, view: torch.Tensor, split: brdf.SplitSum, tables: LightTables) -> torch.Tensor:
    """Light (n, 3) of the environment in the prefiltered one of the two lobes of unit normals."""
    mirror = split.mirror.unsqueeze(1)
    cosine = (normal * view).sum(dim=1, keepdim=True)
    direction = (1.0 + mirror * (2.0 * cosine - 1.0)) * normal - mirror * view
    return tables.specular(direction, split.roughness)


def unit(normal: torch.Tensor) -> torch.Tensor:
    """The normals (n, 3) with unit length; one shorter than .01 gets no gradient."""
    squared = (normal * normal).sum(dim=1, keepdim=True)
    found = normal * squared.clamp_min(float(kernels.MIN_SQUARED_LENGTH)).rsqrt()
    return torch.where(squared > float(kernels.MIN_SQUARED_LENGTH), found, found.detach())


def soft_cosine(cosine: torch.Tensor) -> torch.Tensor:
    """n·v (n,) clamped smoothly, see `shade`."""
    return 0.5 * (cosine + (cosine * cosine + 4.0 * float(kernels.COSINE_CLAMP_WIDTH) ** 2).sqrt())


def mirror_weight(roughness: torch.Tensor) -> torch.Tensor:
    """Share (n,) of the lobe that follows the mirror direction, 1 at roughness 0 and 0 at roughness 1: s (√s + α) with s = 1 − α, which is
    how far the lobe's dominant direction does (Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014)."""
    alpha = roughness.clamp(0.0, 1.0).square()
    smoothness = 1.0 - alpha
    return smoothness.pow(1.5) + smoothness * alpha


def specular_occlusion(normal: torch.Tensor, view: torch.Tensor, roughness: torch.Tensor, occlusion: torch.Tensor) -> torch.Tensor:
    """Specular occlusion (n,) of Lagarde & de Rousiers, 1 = unoccluded. Only the ambient occlusion gets a gradient."""
    with torch.no_grad():
        cosine = soft_cosine((unit(normal) * view).sum(dim=1)).clamp_max(1.0)
        exponent = torch.exp2(-16.0 * roughness - 1.0)
    return ((cosine + occlusion).clamp_min(1e-3) ** exponent - 1.0 + occlusion).clamp(0.0, 1.0)


def _reference(
    normal: torch.Tensor,
    view: torch.Tensor,
    albedo: torch.Tensor,
    roughness: torch.Tensor,
    metallic: torch.Tensor,
    visibility_d: torch.Tensor,
    visibility_s: torch.Tensor,
    tables: LightTables,
) -> torch.Tensor:
    """Reference implementation of `shade` in PyTorch, for any device and precision."""
    surface = unit(normal)
    cosine = (surface * view).sum(dim=1, keepdim=True)
    split = brdf.split_sum(soft_cosine(cosine.squeeze(1)), roughness)
    irradiance = tables.diffuse(surface)
    diffuse = ((1.0 - metallic) * (1.0 - split.dielectric)).unsqueeze(1) * albedo * irradiance
    specular = specular_light(surface, view, split, tables, irradiance) * reflectance(split, metallic.unsqueeze(1) * albedo, metallic)
    return visibility_d.unsqueeze(1) * diffuse + visibility_s.unsqueeze(1) * specular


class _Kernel(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, layout: Any, *inputs: torch.Tensor) -> torch.Tensor:
        flat = [t.detach().contiguous() for t in inputs]
        ctx.save_for_backward(*flat)
        ctx.constants = (
            np.array(layout.roughness, dtype=np.float32),
            np.array(layout.sizes, dtype=np.int64),
            np.array(layout.offsets, dtype=np.int64),
            brdf.split_sum_table(),
        )
        out = torch.empty_like(flat[0])
        kernels.forward(*(t.numpy() for t in flat), *ctx.constants, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        flat = ctx.saved_tensors
        input_grads = [torch.empty_like(t) for t in flat[:-1]]
        table_grad = torch.zeros((kernels.CHUNKS, *flat[-1].shape), dtype=flat[-1].dtype)
        arrays = [t.numpy() for t in flat]
        kernels.backward(*arrays, *ctx.constants, grads[0].contiguous().numpy(), *(t.numpy() for t in input_grads), table_grad.numpy())
        return (None, *input_grads, table_grad.sum(dim=0))
