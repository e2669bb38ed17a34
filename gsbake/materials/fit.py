"""The material fit: base colour, roughness and metallic of every texel and the environment map, optimised against the photos.

Inverse rendering in texture space: with mesh, atlas and cameras fixed, each step shades the pixels of one photo (split sum, METHOD §6) and
takes an Adam step on texels, normal offsets and light. The loss is

    Σ w ρ(sRGB(shade) − photo) + smoothness · |∇ texture| + base_color_l1 · mean (1 − metallic) base colour + metallic_l1 · mean metallic
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

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.metrics import decibels
from gsbake.materials import fit_kernel
from gsbake.materials.base_color_noise import without_noise
from gsbake.materials.bilateral import Neighbourhoods
from gsbake.materials.emission import find_emission
from gsbake.materials.fit_surface import FitSurface, Fitted
from gsbake.materials.intensity_prior import IntensityPrior
from gsbake.materials.light_intensity import LightAdjustment, adjust_radiance, search_light
from gsbake.materials.light_optimiser import LightOptimiser
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.materials.metallic import find_metals
from gsbake.materials.options import FitOptions, FitSchedule, Priors
from gsbake.materials.photo_batch import (
    DIFFUSE,
    EMISSION,
    F0,
    INDIRECT,
    NORMAL,
    ROUGHNESS,
    VISIBILITY,
    FitStep,
    KernelTables,
    PhotoBatch,
    PhotoLights,
    TexelInputs,
    texel_weight,
)
from gsbake.materials.pixels import Pixels
from gsbake.materials.remaining_shading import MATCHED_POINTS, remaining_shading, with_irradiance_factor
from gsbake.materials.sparsity_prior import common_materials
from gsbake.materials.texel_optimiser import TexelOptimiser
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import mean_radiance, rotated
from gsbake.shading.light_tables import irradiance, prefilter_cube_map
from gsbake.shading.neutral_light import neutral_light_loss
from gsbake.texturing.resampling import DETAIL_OFFSET, MAX_DETAIL_RATIO

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FitState:
    """Materials `values` (n, 5) of the texels and the light's `radiance` (6, size, size, 3)."""

    values: Floats
    radiance: Floats


class MaterialFit:
    """Texels and light while they are optimised."""

    def __init__(
        self,
        surface: FitSurface,
        light_size: int,
        priors: Priors,
        roughness: float,
        metallic: float = 0.05,
        options: FitOptions | None = None,
    ) -> None:
        """`light_size` is the edge of the environment map's faces in texels; `roughness`, `metallic` the initial values of all texels."""
        self._surface, self._priors, self._options = surface, priors, options or FitOptions()
        o, n = self._options, len(surface.texels)
        values = np.zeros((n, fit_kernel.PARAMETERS), np.float32)
        values[:, :3] = np.clip(surface.base_color, *o.base_color_range)
        values[:, 3], values[:, 4] = roughness, metallic
        self._texels = TexelOptimiser(surface, priors, o, values)
        self._neighbourhoods = Neighbourhoods(surface.texels, surface.pairs, surface.base_color)
        self._metal_start, self.emissive_regions = metallic > o.max_dielectric_metallic, 0
        self._adjustments: list[LightAdjustment] = []
        self._step_buffers = FitStep(n)
        self._normal = np.ascontiguousarray(surface.normal, np.float32)
        self._transport = np.zeros((n, fit_kernel.TRANSPORT), np.float32)
        self._transport[:, :2] = surface.occlusion[:, None]
        self._transport[:, NORMAL] = self._unit_normals
        self._lit = LightOptimiser(light_size, o)
        self._common = np.zeros((0, 4), np.float32)
        self._rotations: list[NDArray[np.float64] | None] = []  # of the fitted photos' lights
        self._residual = np.zeros(2)  # sums of weighted squared errors and of weights

    @property
    def _values(self) -> Floats:
        """The present values (n, PARAMETERS) of the texels."""
        return self._texels.values

    def continued_on(self, surface: FitSurface, up: Callable[[NDArray[Any]], Floats]) -> MaterialFit:
        """A fit on the finer texels of `surface` that starts from this one; `up` interpolates values (n, c) at the finer texels.

        Base colour takes its detail from the surface's initial one.
        """
        o = self._options
        fit = MaterialFit(surface, self._lit.light.size, self._priors, 0.5, options=o)
        values = up(self._values)
        detail = (surface.base_color + DETAIL_OFFSET) / (up(self._surface.base_color) + DETAIL_OFFSET)
        values[:, :3] = np.clip(values[:, :3] * np.clip(detail, 1 / MAX_DETAIL_RATIO, MAX_DETAIL_RATIO), *o.base_color_range)
        values[:, 3:5] = np.clip(values[:, 3:5], o.min_base_color, 1 - o.min_base_color)
        fit._texels = TexelOptimiser(surface, self._priors, o, np.ascontiguousarray(values, np.float32))
        fit._lit.replace(self._lit.light)
        if self.emissive_regions:
            fit._transport[:, EMISSION] = up(self._transport[:, EMISSION])
        fit._metal_start, fit.emissive_regions, fit._adjustments = self._metal_start, self.emissive_regions, self._adjustments
        return fit

    def run(
        self,
        photos: list[Pixels],
        held_out: list[Pixels],
        schedule: FitSchedule,
        each: Callable[[int, int], None] | None = None,
    ) -> Fitted:
        """Fit to `photos`; `held_out` are only used to evaluate the result. `each(done, total)` is called after every step."""
        o, steps, generator = self._options, schedule.iterations, np.random.default_rng(schedule.seed)
        batches = self._batches(photos)
        order: list[int] = []
        self._common, self._residual = np.zeros((0, 4), np.float32), np.zeros(2)
        weight = texel_weight(batches, len(self._values))
        self._rotations = [batch.to_light for batch in batches]
        given = self._lights() if schedule.fixed_light else None
        for step in range(steps if batches else 0):
            update_common = step % o.sparsity_interval == 0
            if schedule.emission and step == int(o.emission_search_at * steps):
                self.emissive_regions = self._search_emission(batches)
            if step in {int(share * steps) for share in schedule.light_searches_at}:
                tint = not schedule.diffuse or len(self._adjustments) < o.diffuse_tint_searches
                self._adjustments.append(self._search_light(batches, generator, tint, rough=not self._adjustments))
                update_common = True
            if step in {int(share * steps) for share in schedule.light_scaled_at} and not self.mostly_dielectric:
                self._scale_light()
            if not schedule.diffuse and step in {int(share * steps) for share in schedule.metal_searches_at}:
                self._search_metals(batches)
                update_common = True
            if step % o.visibility_interval == 0:
                self._update_transport()
                self._residual *= o.residual_decay
            if schedule.sparsity and self._priors.sparsity and update_common and step >= o.sparsity_from * steps:
                self._common = self._find_common_materials()
            order = order or generator.permutation(len(batches)).tolist()
            decay, light_decay = (schedule.rate * final ** (step / steps) for final in (o.final_rate, o.light_final_rate))
            self._step(batches[order.pop()], decay, light_decay, given, schedule.normals)
            if each is not None:
                each(step + 1, steps)
        values, emission = self._values[:, :5].copy(), self._transport[:, EMISSION].copy()
        loss, squared = self._errors(held_out) or (None, None)
        psnr = None if squared is None else decibels(squared)
        offset = self._values[:, 5:].copy()
        return Fitted(values, offset, weight, emission, self._lit.light, psnr, loss, self.emissive_regions, tuple(self._adjustments))

    def _batches(self, photos: list[Pixels]) -> list[PhotoBatch]:
        return [PhotoBatch.of(p, self._normal) for p in photos if len(p)]

    def _step(self, batch: PhotoBatch, decay: float, light_decay: float, given: PhotoLights | None, normals: bool) -> None:
        """One Adam step on the pixels of one photo, with learning rates times the decays; of the texels alone under a `given` light."""
        if given is not None:
            self._shade(batch, given.tables(batch.to_light))
            self._update_texels(decay, normals)
            return
        radiance = self._lit.light.radiance()
        tables = prefilter_cube_map(rotated(radiance, batch.to_light))
        self._shade(batch, KernelTables.of(tables))
        loss = (tables.table * torch.from_numpy(self._step_buffers.table.sum(0))).sum()
        if self._priors.neutral_light:
            loss = loss + len(self._values) * self._priors.neutral_light * neutral_light_loss(radiance)
        self._lit.step(loss, light_decay)
        self._update_texels(decay, normals)

    def _shade(self, batch: PhotoBatch, tables: KernelTables) -> None:
        """Shade the pixels of a photo, leave the gradients in the buffers and add to the sums of the residual."""
        o = self._options
        factor = len(self._values) / len(batch)
        self._residual += self._step_buffers(batch, self._values, tables, self._transport, o.residual_weight, o.robust_scale, factor)[1:]

    def _update_texels(self, decay: float, normals: bool) -> None:
        """One step on all texels, from the gradient of the photo and those of the priors."""
        residual = float(self._residual[0] / max(self._residual[1], 1e-6) / self._options.robust_scale**2)
        self._texels.step(self._step_buffers.gradient, residual, self._common, decay, normals)

    def _update_transport(self) -> None:
        """Visibility, indirect light and what reflections show under the present light and materials."""
        transport = self._surface.transport
        if transport is None:
            return
        visible = transport.visible_share(self._mean_radiance())
        self._transport[:, VISIBILITY] = visible
        if self._surface.indirect:
            # Albedo of both lobes together, (1 − m) base colour + F0: indirect light is not sharp enough to depend on roughness.
            reflectance = self._values[:, :3] + np.float32(0.04) * (1 - self._values[:, 4:5])
            lit = self._irradiance() * visible[:, None]
            indirect = transport.indirect_irradiance(lit, reflectance)
            self._transport[:, INDIRECT] = indirect
            metal = self._values[:, 4:5] * self._values[:, :3]
            self._transport[:, DIFFUSE] = (self._values[:, :3] - metal) * (lit + indirect)
            self._transport[:, F0] = metal + np.float32(0.04) * (1 - self._values[:, 4:5])
            self._transport[:, ROUGHNESS] = self._values[:, 3]

    def _mean_radiance(self) -> Floats:
        """The environment map (6, size, size, 3) in the object's frame, the mean over photos where the light moves."""
        return mean_radiance(self._lit.radiance(), self._rotations)

    def _irradiance(self) -> Floats:
        """Irradiance / π (n, 3) of unoccluded texels, the mean over photos where the light moves."""
        return irradiance(self._mean_radiance(), self._normal)

    def _lights(self) -> PhotoLights:
        """The present light as photos see it."""
        return PhotoLights(self._lit.light.radiance().detach())

    def _find_common_materials(self) -> Floats:
        """The common material (n, 4) that the sparsity prior draws each texel to; emissive texels, whose base colour hardly shows, keep
        their own."""
        return common_materials(self._values[:, :5], self._non_emissive())

    def _non_emissive(self) -> NDArray[np.bool_]:
        """Which texels (n,) do not emit."""
        return np.asarray(self._transport[:, EMISSION].sum(1) == 0)

    def _dielectric(self) -> NDArray[np.bool_]:
        """Which texels (n,) are dielectric and do not emit."""
        return np.asarray((self._values[:, 4] < self._options.max_dielectric_metallic) & self._non_emissive())

    @torch.no_grad()
    def _search_light(self, batches: list[PhotoBatch], generator: np.random.Generator, tint: bool, rough: bool) -> LightAdjustment:
        """Search for the light's intensity and contrast and for a roughness shift, apply them, and adapt base colours."""
        o, values = self._options, self._values
        if not self.mostly_dielectric:
            return self._scale_light()
        dielectric = self._dielectric()
        share = min(1.0, o.intensity_pixels / max(1, sum(map(len, batches))))
        chosen = dielectric & (generator.random(len(dielectric)) < share)
        step = -(-len(batches) // o.moving_light_photos) if self.moving_light else 1
        subset = [part for b in batches[::step] if len(part := b.select(chosen))]
        if not subset:
            return LightAdjustment(np.ones(3), 1.0, 0.0, 0.0)
        radiance, area = self._lit.radiance(), solid_angles(self._lit.light.size)
        visible: dict[float, Floats] = {}  # the share does not depend on the intensity, and hardly on the tint

        def adjusted(intensity: NDArray[np.float64], contrast: float) -> EnvironmentLight:
            return EnvironmentLight.from_radiance(adjust_radiance(radiance, intensity, contrast, area))

        def samples_under(intensity: NDArray[np.float64], contrast: float) -> list[PhotoSamples]:
            light = adjusted(intensity, contrast)
            transport = self._transport.copy()
            if self._surface.transport is not None:
                if contrast not in visible:
                    visible[contrast] = self._surface.transport.visible_share(mean_radiance(light.radiance().numpy(), self._rotations))
                transport[:, VISIBILITY] = visible[contrast]
            lights, texels = PhotoLights(light.radiance()), TexelInputs.of(values, transport)
            return [b.samples(texels, lights.tables(b.to_light)) for b in subset]

        prior = IntensityPrior(self.intensity_prior().dielectrics)  # reflections of dielectrics tell of the light
        found = search_light(samples_under, values[:, 3].copy(), tint, rough, prior)
        if found.improvement <= 0:
            return found
        values[dielectric, 3] = found.shifted_roughness(values[dielectric, 3])
        self._change_light(adjusted(found.intensity, found.contrast), np.flatnonzero(dielectric))
        return found

    @torch.no_grad()
    def _change_light(self, light: EnvironmentLight, texel: NDArray[np.int64]) -> None:
        """Replace the light, and change the base colours of the texels (m,) so that their diffuse colours stay."""
        o = self._options
        before = self._irradiance() * self._transport[:, :1] + self._transport[:, INDIRECT]
        self._lit.replace(light)
        self._update_transport()
        after = self._irradiance() * self._transport[:, :1] + self._transport[:, INDIRECT]
        new = self._values[texel, :5]
        new[:, :3] = np.clip(new[:, :3] * before[texel] / np.maximum(after[texel], 1e-6), o.min_base_color, o.base_color_range[1])
        self._texels.reinitialise(texel, new)

    @property
    def moving_light(self) -> bool:
        """Whether the light moves from photo to photo."""
        return any(rotation is not None for rotation in self._rotations)

    @property
    def mostly_dielectric(self) -> bool:
        """Whether so much is dielectric that its diffuse colours tell of the light."""
        return bool(self._dielectric().mean() >= self._options.min_dielectric_share)

    def rescale_metallic(self) -> None:
        """Scale metallic, where it is above .5, so that its median there is 1: metals are pure.

        Gradient steps leave it lower, as a share of diffuse reflection makes up for reflections that are misplaced.
        """
        texel = np.flatnonzero(self._values[:, 4] > 0.5)
        if len(texel):
            new = self._values[texel, :5]
            new[:, 4] = np.minimum(new[:, 4] / np.median(new[:, 4]), self._options.max_metallic)
            self._texels.reinitialise(texel, new)

    def find_remaining_shading(self, seed: int) -> NDArray[np.float64]:
        """Coefficients (8, 3) of the log shading that is left in the base colours of dielectrics."""
        texel = np.flatnonzero(self._dielectric())
        position = np.asarray(self._surface.position)[texel]
        return remaining_shading(self._values[texel, :3], self._unit_normals[texel], position, np.random.default_rng(seed))

    @torch.no_grad()
    def move_to_light(self, shading: NDArray[np.float64], seed: int) -> None:
        """Move `shading` of these coefficients (8, 3) from the base colours of dielectrics to the light."""
        texel = np.flatnonzero(self._dielectric())
        matched = self._unit_normals[np.random.default_rng(seed).choice(texel, min(MATCHED_POINTS, len(texel)), replace=False)]
        light = with_irradiance_factor(self._lit.radiance(), shading, matched, partial(irradiance, normals=matched))
        self._change_light(EnvironmentLight.from_radiance(light), texel)

    @cached_property
    def _unit_normals(self) -> Floats:
        """The mesh's unit normals (n, 3) at the texels."""
        return self._normal / np.maximum(np.linalg.norm(self._normal, axis=1, keepdims=True), 1e-12)

    def intensity_prior(self) -> IntensityPrior:
        """The prior of the present intensity of the light."""
        return IntensityPrior.of(self._values, self._dielectric(), None if self.moving_light else self._mean_radiance())

    @torch.no_grad()
    def _scale_light(self) -> LightAdjustment:
        """Scale the light to the intensity expected by the prior, and base colours with it: reflections of metal leave the scale open."""
        o, factor = self._options, 1 / self.intensity_prior().mean_factor()
        self._lit.replace(self._lit.radiance() / np.float32(factor))
        new = self._values[:, :5].copy()
        new[:, :3] = np.clip(new[:, :3] * np.float32(factor), o.min_base_color, o.base_color_range[1])
        self._texels.reinitialise(np.arange(len(new)), np.clip(new, 1e-6, 1 - 1e-6))
        self._update_transport()
        return LightAdjustment(np.full(3, 1 / factor), 1.0, 0.0, 0.0)

    def _samples(self, batches: list[PhotoBatch], tilted: bool = False) -> list[PhotoSamples]:
        """All pixels under the present light, with `tilted` normals as well."""
        lights, texels = self._lights(), TexelInputs.of(self._values, self._transport)
        return [b.samples(texels, lights.tables(b.to_light), tilted) for b in batches]

    def _search_metals(self, batches: list[PhotoBatch]) -> None:
        """Reinitialise texels that are detected as metal, and from a metallic start those that are dielectric."""
        o = self._options
        wide = self._neighbourhoods.wide  # errors of a moving light, which is an approximation, are similar all over a near one
        near = wide if self.moving_light else self._neighbourhoods.near(self._values)
        found = find_metals(self._metal_samples(batches), self._values[:, 3].copy(), near, wide)
        kinds = [(found.texel, found.base, found.roughness, o.detected_metallic)]
        if self._metal_start:
            kinds.append((*found.dielectric, o.detected_dielectric))
        for texel, base, roughness, metallic in kinds:
            # A texel that already is of its kind keeps its values.
            other = (self._values[texel, 4] > 0.5) != (metallic > 0.5) if self._metal_start else np.ones(len(texel), bool)
            values = np.column_stack([np.clip(base, *o.base_color_range), roughness, np.full(len(texel), metallic)])
            self._texels.reinitialise(texel[other], values[other])

    def _search_emission(self, batches: list[PhotoBatch]) -> int:
        """Set the radiance of emissive regions and reinitialise their base colour to black; the number of regions."""
        o, position = self._options, np.asarray(self._surface.position, np.float64)
        found = find_emission(self._samples(batches), self._values[:, 3].copy(), self._surface.pairs, position)
        self._transport[found.texel, EMISSION] = found.radiance
        black = self._values[found.texel, :5]
        black[:, :3], black[:, 4] = o.base_color_range[0], o.detected_dielectric
        self._texels.reinitialise(found.texel, black)
        return found.regions

    def state(self) -> FitState:
        """The materials and the light, to return to with `restore`."""
        return FitState(self._values[:, :5].copy(), self._lit.radiance())

    def restore(self, state: FitState, photos: list[Pixels]) -> None:
        """Return to a `state` of a fit to `photos`; moments of the optimisers start anew."""
        self._rotations = [pixels.to_light for pixels in photos]
        self._lit.replace(state.radiance)
        self.set_materials(np.arange(len(state.values)), state.values)

    def set_materials(self, texel: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Set the materials of texels (m,) to `values` (m, 5), within the range of logits, and what follows from them."""
        tiny = self._options.min_base_color
        self._texels.reinitialise(texel, np.clip(values, tiny, 1 - tiny))
        self._update_transport()

    def kind(self, metal: bool) -> float:
        """Metallic of texels that become `metal` or dielectric."""
        return self._options.detected_metallic if metal else self._options.detected_dielectric

    def remove_noise(self, photos: list[Pixels]) -> None:
        """Take out of metals' base colours the noise that two halves of the `photos` tell."""
        surface, metal = self._surface, (self._values[:, 4] > 0.5) & self._non_emissive()
        base = without_noise(self.metal_samples(photos), self._values, metal, surface.texels, surface.pairs)
        texel = np.flatnonzero(metal)
        self.set_materials(texel, np.column_stack([base[texel], self._values[texel, 3:5]]))

    def metal_samples(self, photos: list[Pixels]) -> list[PhotoSamples]:
        """The pixels of `photos` that a search for metals uses, with tilted normals, under the present light."""
        return self._metal_samples(self._batches(photos))

    def _metal_samples(self, batches: list[PhotoBatch]) -> list[PhotoSamples]:
        step = max(1, sum(map(len, batches)) // (self._options.metal_pixels * len(self._values)))
        return self._samples([batch.every(step) for batch in batches], tilted=True)

    def samples_of(self, pixels: Pixels, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], PhotoSamples]:
        """Which (m,) of the `pixels` have a dominant texel that is `chosen` (n,), and their samples under the fitted light."""
        batch = PhotoBatch.of(pixels, self._normal)
        texels = TexelInputs.of(self._values, self._transport)
        samples = batch.select(chosen).samples(texels, self._lights().tables(batch.to_light))
        return np.flatnonzero(chosen[batch.dominant_texel]), samples

    def psnr(self, photos: list[Pixels], values: Floats | None = None) -> float | None:
        """PSNR in dB over all pixels of `photos` (None without any), with the fitted texels or with `values` (n, 5)."""
        found = self._errors(photos, values)
        return None if found is None else decibels(found[1])

    def _errors(self, photos: list[Pixels], values: Floats | None = None) -> tuple[float, float] | None:
        """Mean robust and mean squared error over all pixels of `photos`; None without any."""
        batches = [replace(batch, weight=np.ones_like(batch.weight)) for batch in self._batches(photos)]
        if not batches:
            return None
        materials = self._values if values is None else np.column_stack([values[:, :5], self._values[:, 5:]]).astype(np.float32)
        lights, scale = self._lights(), self._options.comparison_scale
        sums = np.sum(
            [self._step_buffers(b, materials, lights.tables(b.to_light), self._transport, 1.0, scale, 0.0) for b in batches], axis=0
        )
        return float(sums[0] / sums[2]), float(sums[1] / sums[2])
