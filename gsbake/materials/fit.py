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
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.metrics import decibels
from gsbake.materials.emission import find_emission
from gsbake.materials.fit_model import FitModel
from gsbake.materials.fit_surface import FitSurface, Fitted
from gsbake.materials.light_intensity import LightAdjustment, adjust_radiance, search_light
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.materials.metallic import find_metals
from gsbake.materials.options import FitOptions, FitSchedule, Priors
from gsbake.materials.photo_batch import (
    EMISSION,
    VISIBILITY,
    KernelTables,
    PhotoBatch,
    PhotoLights,
    TexelInputs,
    texel_weight,
)
from gsbake.materials.pixels import Pixels
from gsbake.materials.sparsity_prior import common_materials
from gsbake.materials.texel_optimiser import TexelOptimiser
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import mean_radiance, rotated
from gsbake.shading.light_tables import prefilter_cube_map
from gsbake.shading.neutral_light import neutral_light_loss
from gsbake.texturing.resampling import DETAIL_OFFSET, MAX_DETAIL_RATIO

Floats = NDArray[np.float32]


class MaterialFit(FitModel):
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
        super().__init__(surface, light_size, priors, roughness, metallic, options or FitOptions())
        self._priors = priors
        self._metal_start, self.emissive_regions = metallic > self._options.max_dielectric_metallic, 0
        self._adjustments: list[LightAdjustment] = []
        self._common = np.zeros((0, 4), np.float32)
        self._residual = np.zeros(2)  # sums of weighted squared errors and of weights

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

    def _find_common_materials(self) -> Floats:
        """The common material (n, 4) that the sparsity prior draws each texel to; emissive texels, whose base colour hardly shows, keep
        their own."""
        return common_materials(self._values[:, :5], self._non_emissive())

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

        prior = replace(self.intensity_prior(), metals=None)  # reflections of dielectrics tell of the light
        found = search_light(samples_under, values[:, 3].copy(), tint, rough, prior)
        if found.improvement <= 0:
            return found
        values[dielectric, 3] = found.shifted_roughness(values[dielectric, 3])
        self._change_light(adjusted(found.intensity, found.contrast), np.flatnonzero(dielectric))
        return found

    def _search_metals(self, batches: list[PhotoBatch]) -> None:
        """Reinitialise texels that are detected as metal, and from a metallic start those that are dielectric."""
        o = self._options
        wide = self._surface.neighbourhoods.wide  # errors of a moving light, which is an approximation, are similar all over a near one
        near = wide if self.moving_light else self._surface.neighbourhoods.near(self._values)
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
