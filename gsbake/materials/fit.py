"""The material fit: base colour, roughness and metallic of every texel and the environment map, optimised against the photos.

Inverse rendering in texture space: with mesh, atlas and cameras fixed, each step shades the pixels of one photo (split sum, METHOD §6) and
takes an Adam step on texels, normal offsets and light. The loss is

    Σ w ρ(sRGB(shade) − photo) + smoothness · |∇ texture| + base_color_l1 · mean base colour + metallic_l1 · mean metallic
    + neutral_light · colourfulness of the light + sparsity · residual · |texture − common materials|²

ρ is pseudo-Huber, so that a misplaced reflection has little influence; a plain L1 error ignores reflections that are slightly off and makes
the light too dim. The other terms are priors for what photos under one light leave open: neighbouring texels are similar; the L1 norm of
base colour resolves the albedo–illumination ambiguity; most surfaces are dielectric; most light is neutral; an object has few materials
(`sparsity_prior`, scaled by the residual: where photos are explained, they decide).

Some parameters are searched for at given steps, because gradients do not reach them: the light's intensity and contrast
(`light_intensity`), metals (`metallic`) and emissive regions (`emission`). The steps that follow may revise what was found. The initial
roughness is chosen by `initialisation`. Normal offsets let reflections refine the mesh's normals. Visibility of the light and indirect
light are updated every few steps without gradient (`visibility`), so that neither shadows nor interreflections end up in base colour.

Munkberg et al., *Extracting triangular 3D models, materials, and lighting from images*, CVPR 2022, fit textures and a split-sum light
together in this way; visibility per texel and weights per view are added by the fixed mesh.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.metrics import decibels
from gsbake.imaging.srgb_torch import linear_to_srgb
from gsbake.materials.bilateral import EdgeAwareFilter
from gsbake.materials.emission import find_emission
from gsbake.materials.light_intensity import LightAdjustment, adjust_radiance, search_light
from gsbake.materials.metallic import PhotoSamples, find_metals
from gsbake.materials.options import FitOptions, FitSchedule, Priors
from gsbake.materials.pixel_shading import EMISSION, INDIRECT, OUTGOING, TRANSPORT_CHANNELS, VISIBILITY, Batch
from gsbake.materials.pixels import Pixels
from gsbake.materials.sparsity_prior import KERNEL_WIDTHS, common_materials
from gsbake.materials.visibility import Visibility
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.neutral_light import neutral_light_loss
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Fitted:
    """Result of a fit.

    `values` (n, 5): linear base colour, roughness, metallic of each texel; `normal_offset` (n, 3) to be added to its unit normal; `weight`
    (n,) of all pixels that show it; `emission` (n, 3) its emitted radiance; the `light` in the mesh's frame; `held_out_psnr` in dB over the
    pixels of held-out photos (None without any); `metal` (n,) the texels last detected as metal and still metallic; the number of
    `emissive_regions`; `light_adjustments`, one per search for the light's intensity.
    """

    values: Floats
    normal_offset: Floats
    weight: Floats
    emission: Floats
    light: EnvironmentLight
    held_out_psnr: float | None
    metal: NDArray[np.bool_]
    emissive_regions: int
    light_adjustments: tuple[LightAdjustment, ...]


@dataclass(frozen=True)
class FitSurface:
    """The n texels of a texture with their geometry.

    `position`, unit `normal` (n, 3) in the mesh's frame; `pairs` (m, 2) neighbouring texels, shuffled as `gsbake.materials.adjacency` does;
    `occlusion` (n,) ambient occlusion, 1 = open; `base_color` (n, 3) the initial linear base colour. With `visibility` shadows follow the
    light, with `indirect` texels light each other as well.
    """

    texels: Texels
    position: NDArray[Any]
    pairs: NDArray[np.int64]
    normal: NDArray[Any]
    occlusion: NDArray[Any]
    base_color: NDArray[Any]
    visibility: Visibility | None = None
    indirect: bool = True


class MaterialFit:
    """Texels and light while they are optimised."""

    def __init__(self, surface: FitSurface, light_size: int, priors: Priors, roughness: float, options: FitOptions | None = None) -> None:
        """`light_size` is the edge of the environment map's faces in texels, `roughness` the initial value of all texels."""
        self._surface, self._priors, self._options = surface, priors, options or FitOptions()
        o, n = self._options, len(surface.texels)
        logits = torch.zeros(n, 5)
        logits[:, :3] = torch.logit(torch.as_tensor(np.clip(surface.base_color, *o.base_color_range), dtype=torch.float32))
        logits[:, 3] = math.log(roughness / (1 - roughness))
        logits[:, 4] = math.log(o.initial_metallic / (1 - o.initial_metallic))
        self._logits = logits
        self._normal = torch.as_tensor(np.ascontiguousarray(surface.normal, np.float32))
        self._normal_offset = torch.zeros(n, 3, requires_grad=True)
        # The change of normals per texel grows with the size of texels.
        self._normal_smoothness = o.normal_smoothness * (surface.texels.size / 512) ** 2
        occlusion = torch.as_tensor(np.ascontiguousarray(surface.occlusion, np.float32))[:, None]
        self._transport = torch.cat([occlusion, occlusion, torch.zeros(n, TRANSPORT_CHANNELS - 2)], 1)
        self._light = EnvironmentLight(light_size)
        self._common: torch.Tensor | None = None
        self._residual = torch.zeros(2)  # sums of weighted squared errors and of weights
        self._channels, self._kernel_widths = torch.tensor(o.smoothness_channels), torch.tensor(KERNEL_WIDTHS)
        self._pairs = torch.as_tensor(surface.pairs)
        self._adam = torch.optim.Adam([self._logits.requires_grad_()], lr=o.texel_rate, betas=o.betas, eps=o.epsilon)
        self._adam_normal = torch.optim.Adam([self._normal_offset], lr=o.normal_rate, betas=o.betas, eps=o.epsilon)
        self._adam_light = torch.optim.Adam([self._light.raw], lr=o.light_rate, betas=o.betas)

    def run(
        self,
        photos: list[Pixels],
        held_out: list[Pixels],
        schedule: FitSchedule,
        each: Callable[[int, int], None] | None = None,
    ) -> Fitted:
        """Fit to `photos`; `held_out` are only used to evaluate the result. `each(done, total)` is called after every step."""
        o, steps, generator = self._options, schedule.iterations, torch.Generator().manual_seed(schedule.seed)
        batches = [Batch.of(p, self._normal) for p in photos if len(p)]
        order: list[int] = []
        metal, emissive_regions = np.zeros(len(self._logits), bool), 0
        adjustments: list[LightAdjustment] = []
        self._common, self._residual = None, torch.zeros(2)
        for step in range(steps if batches else 0):
            update_common = step % o.sparsity_interval == 0
            if schedule.emission and step == int(o.emission_search_at * steps):
                emissive_regions = self._search_emission(batches)
            if schedule.intensity and step in {int(share * steps) for share in o.intensity_searches_at}:
                tint = not schedule.diffuse or len(adjustments) < o.diffuse_tint_searches
                adjustments.append(self._search_light(batches, generator, tint, rough=not adjustments))
                update_common = True
            if schedule.metallic and not schedule.diffuse and step in {int(share * steps) for share in o.metal_searches_at}:
                metal = self._search_metals(batches)
                update_common = True
            if step % o.visibility_interval == 0:
                self._update_transport()
                self._residual *= o.residual_decay
            if schedule.sparsity and self._priors.sparsity and update_common and step >= o.sparsity_from * steps:
                self._common = self._find_common_materials()
            order = order or torch.randperm(len(batches), generator=generator).tolist()
            self._step(batches[order.pop()], o.final_rate ** (step / steps), generator)
            if each is not None:
                each(step + 1, steps)
        with torch.no_grad():
            values = torch.sigmoid(self._logits).numpy()
        normal_offset, emission = self._normal_offset.detach().numpy(), self._transport[:, EMISSION].numpy()
        metal &= values[:, 4] > o.min_metallic
        weight, psnr = self._texel_weight(batches), self.psnr(held_out)
        return Fitted(values, normal_offset, weight, emission, self._light, psnr, metal, emissive_regions, tuple(adjustments))

    def _texel_weight(self, batches: list[Batch]) -> Floats:
        """Total weight (n,) of the pixels that show each texel."""
        weight = torch.zeros(len(self._logits))
        for batch in batches:
            for k in range(4):
                weight.index_add_(0, batch.texel[:, k], batch.bilinear[:, k] * batch.weight)
        return np.asarray(weight.numpy())

    def _step(self, batch: Batch, decay: float, generator: torch.Generator) -> None:
        """One Adam step on the pixels of one photo, with learning rates times `decay`."""
        o = self._options
        loss = self._loss(batch, generator)
        optimisers = (self._adam, o.texel_rate), (self._adam_normal, o.normal_rate), (self._adam_light, o.light_rate)
        for adam, rate in optimisers:
            adam.zero_grad()
            adam.param_groups[0]["lr"] = rate * decay
        (loss * len(self._logits)).backward()
        for adam, _ in optimisers:
            adam.step()

    def _loss(self, batch: Batch, generator: torch.Generator) -> torch.Tensor:
        """The loss in the module's docstring on one photo, per texel."""
        o, priors, values = self._options, self._priors, torch.sigmoid(self._logits)
        shaded = batch.shade(values, self._normal_offset, self._light.prefilter(), self._transport)
        # Clamped: a reflection brighter than white that the photo does not show has no gradient; it is misplaced rather than too bright.
        error = linear_to_srgb(shaded.clamp(0, 1)) - batch.colour
        squares = error.square()
        self._residual += torch.stack([(squares.detach().mean(1) * batch.weight).sum(), batch.weight.sum()])
        error = o.residual_weight * ((squares + o.robust_scale**2).sqrt() - o.robust_scale).mean(1)
        loss = (error * batch.weight).mean()
        loss = loss + priors.base_color_l1 * values[:, :3].mean() + priors.metallic_l1 * values[:, 4].mean()
        if priors.neutral_light:
            loss = loss + priors.neutral_light * neutral_light_loss(self._light.radiance())
        if priors.smoothness and len(self._pairs):
            count = max(1, int(o.compared_pairs * len(self._pairs)))
            start = int(torch.randint(len(self._pairs) - count + 1, (1,), generator=generator))
            pair = self._pairs[start : start + count]
            loss = loss + priors.smoothness * ((values[pair[:, 0]] - values[pair[:, 1]]).abs() @ self._channels).mean()
            change = self._normal_offset[pair[:, 0]] - self._normal_offset[pair[:, 1]]
            loss = loss + self._normal_smoothness * (change**2).sum(1).mean()
        if self._common is not None:
            residual = self._residual[0] / self._residual[1].clamp_min(1e-6) / o.robust_scale**2
            distance = (torch.cat([linear_to_srgb(values[:, :3]), values[:, 3:4]], 1) - self._common) / self._kernel_widths
            loss = loss + priors.sparsity * residual * 0.5 * distance.square().sum(1).mean()
        return loss + o.normal_offset_weight * (self._normal_offset**2).sum(1).mean()

    @torch.no_grad()
    def _update_transport(self) -> None:
        """Visibility, indirect light and outgoing radiance under the present light and materials."""
        visibility = self._surface.visibility
        if visibility is None:
            return
        visible = torch.as_tensor(visibility.visible_share(self._light.radiance().numpy()))
        self._transport[:, VISIBILITY] = visible
        if self._surface.indirect:
            values = torch.sigmoid(self._logits)
            # Albedo of both lobes together, (1 − m) base colour + F0: indirect light is not sharp enough to depend on roughness.
            reflectance = values[:, :3] + 0.04 * (1 - values[:, 4:])
            irradiance = self._light.prefilter().diffuse(self._normal) * visible[:, None]
            indirect = torch.as_tensor(visibility.indirect_irradiance(irradiance.numpy(), reflectance.numpy()))
            self._transport[:, INDIRECT] = indirect
            self._transport[:, OUTGOING] = reflectance * (irradiance + indirect) + self._transport[:, EMISSION]

    @torch.no_grad()
    def _find_common_materials(self) -> torch.Tensor:
        """The common material (n, 4) that the sparsity prior draws each texel to; emissive texels, whose base colour hardly shows, keep
        their own."""
        return torch.as_tensor(common_materials(torch.sigmoid(self._logits).numpy(), self._non_emissive().numpy()))

    def _non_emissive(self) -> torch.Tensor:
        """Which texels (n,) do not emit."""
        return self._transport[:, EMISSION].sum(1) == 0

    @torch.no_grad()
    def _search_light(self, batches: list[Batch], generator: torch.Generator, tint: bool, rough: bool) -> LightAdjustment:
        """Search for the light's intensity and contrast and for a roughness shift, apply them, and adapt base colours."""
        o, values = self._options, torch.sigmoid(self._logits)
        dielectric = (values[:, 4] < o.max_dielectric_metallic) & self._non_emissive()
        share = min(1.0, o.intensity_pixels / max(1, sum(len(b.weight) for b in batches)))
        chosen = dielectric & (torch.rand(len(dielectric), generator=generator) < share)
        subset = [part for b in batches if len((part := b.select(chosen)).weight)]
        if not subset:
            return LightAdjustment(np.ones(3), 1.0, 0.0, 0.0)
        radiance, area = self._light.radiance().numpy(), solid_angles(self._light.size)

        def adjusted(intensity: NDArray[np.float64], contrast: float) -> EnvironmentLight:
            return EnvironmentLight.from_radiance(adjust_radiance(radiance, intensity, contrast, area))

        def samples_under(intensity: NDArray[np.float64], contrast: float) -> list[PhotoSamples]:
            light = adjusted(intensity, contrast)
            transport = self._transport.clone()
            if self._surface.visibility is not None:
                transport[:, VISIBILITY] = torch.as_tensor(self._surface.visibility.visible_share(light.radiance().numpy()))
            tables = light.prefilter()
            return [b.samples(self._normal_offset, tables, transport) for b in subset]

        found = search_light(samples_under, values[:, 3].numpy(), tint, rough)
        if found.improvement <= 0:
            return found
        before = self._light.prefilter().diffuse(self._normal) * self._transport[:, :1]
        self._light.raw.copy_(adjusted(found.intensity, found.contrast).raw)
        self._adam_light.state.clear()
        self._update_transport()
        after = self._light.prefilter().diffuse(self._normal) * self._transport[:, :1]
        at = torch.nonzero(dielectric)[:, 0]
        new = values[at].numpy()
        new[:, :3] = np.clip(new[:, :3] * (before[at] / after[at].clamp_min(1e-6)).numpy(), o.min_base_color, o.base_color_range[1])
        new[:, 3] = found.shifted_roughness(new[:, 3])
        self._reinitialise(at.numpy(), new)
        return found

    @cached_property
    def _colour_filter(self) -> EdgeAwareFilter:
        """The edge-aware filter of the initial base colours; built on first use, as trials need none."""
        return EdgeAwareFilter(self._surface.texels, self._pairs.numpy(), self._surface.base_color)

    def _samples(self, batches: list[Batch]) -> list[PhotoSamples]:
        """All pixels under the present light."""
        tables = self._light.prefilter()
        return [b.samples(self._normal_offset, tables, self._transport) for b in batches]

    @torch.no_grad()
    def _search_metals(self, batches: list[Batch]) -> NDArray[np.bool_]:
        """Reinitialise texels that are detected as metal; which (n,) these are."""
        o, samples = self._options, self._samples(batches)
        found = find_metals(samples, torch.sigmoid(self._logits[:, 3]).numpy(), self._colour_filter)
        metallic = np.full(len(found.texel), o.detected_metallic)
        self._reinitialise(found.texel, np.column_stack([np.clip(found.base, *o.base_color_range), found.roughness, metallic]))
        return np.isin(np.arange(len(self._logits)), found.texel)

    @torch.no_grad()
    def _search_emission(self, batches: list[Batch]) -> int:
        """Set the radiance of emissive regions and reinitialise their base colour to black; the number of regions."""
        o, samples = self._options, self._samples(batches)
        values = torch.sigmoid(self._logits).numpy()
        position = np.asarray(self._surface.position, np.float64)
        found = find_emission(samples, values[:, 3], self._pairs.numpy(), position)
        self._transport[torch.as_tensor(found.texel), EMISSION] = torch.as_tensor(found.radiance, dtype=torch.float32)
        black = values[found.texel]
        black[:, :3], black[:, 4] = o.base_color_range[0], o.initial_metallic
        self._reinitialise(found.texel, black)
        return found.regions

    def _reinitialise(self, texel: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Set texels (m,) to `values` (m, 5) and reset the optimiser's moments there."""
        at = torch.as_tensor(texel)
        self._logits[at] = torch.logit(torch.as_tensor(values, dtype=torch.float32))
        for moment in self._adam.state[self._logits].values():
            if moment.shape == self._logits.shape:
                moment[at] = 0

    @torch.no_grad()
    def samples_of(self, pixels: Pixels, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], PhotoSamples]:
        """Which (m,) of the `pixels` have a dominant texel that is `chosen` (n,), and their samples under the fitted light."""
        batch, texels = Batch.of(pixels, self._normal), torch.as_tensor(chosen)
        rows = torch.nonzero(texels[batch.dominant_texel])[:, 0]
        return rows.numpy(), batch.select(texels).samples(self._normal_offset, self._light.prefilter(), self._transport)

    @torch.no_grad()
    def psnr(self, photos: list[Pixels], values: Floats | None = None) -> float | None:
        """PSNR in dB over all pixels of `photos` (None without any), with the fitted texels or with `values` (n, 5)."""
        batches = [Batch.of(p, self._normal) for p in photos if len(p)]
        if not batches:
            return None
        materials, tables = torch.sigmoid(self._logits) if values is None else torch.as_tensor(values), self._light.prefilter()
        shaded = (b.shade(materials, self._normal_offset, tables, self._transport).clamp_min(0) for b in batches)
        squares = torch.cat([((linear_to_srgb(s) - b.colour) ** 2).mean(1) for s, b in zip(shaded, batches, strict=True)])
        return decibels(float(squares.mean()))
