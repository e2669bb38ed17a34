"""What the material fit fits: the texels of a surface and the environment light, and the photos as they show both.

Visibility of the light, indirect light and what reflections show follow from texels and light, and are updated every few steps without
gradient (`visibility`), so that neither shadows nor interreflections end up in base colour. How texels and light are found is in `fit`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.metrics import decibels
from gsbake.materials import fit_kernel
from gsbake.materials.base_color_noise import without_noise
from gsbake.materials.fit_surface import FitSurface
from gsbake.materials.intensity_prior import IntensityPrior
from gsbake.materials.light_intensity import LightAdjustment
from gsbake.materials.light_optimiser import LightOptimiser
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.materials.options import FitOptions, Priors
from gsbake.materials.photo_batch import (
    DIFFUSE,
    EMISSION,
    INDIRECT,
    METAL_COLOUR,
    METALLIC,
    NORMAL,
    ROUGHNESS,
    VISIBILITY,
    FitStep,
    PhotoBatch,
    PhotoLights,
    TexelInputs,
)
from gsbake.materials.pixels import Pixels
from gsbake.materials.remaining_shading import MATCHED_POINTS, remaining_shading, with_irradiance_factor
from gsbake.materials.texel_optimiser import TexelOptimiser
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import mean_radiance
from gsbake.shading.light_tables import irradiance

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FitState:
    """Materials `values` (n, 5) of the texels and the light's `radiance` (6, size, size, 3)."""

    values: Floats
    radiance: Floats


class FitModel:
    """Texels, the light, and what follows from them: visibility, indirect light, reflections of the object in itself."""

    def __init__(
        self, surface: FitSurface, light_size: int, priors: Priors, roughness: float, metallic: float, options: FitOptions
    ) -> None:
        """`light_size` is the edge of the environment map's faces in texels; `roughness`, `metallic` the initial values of all texels."""
        self._surface, self._options, n = surface, options, len(surface.texels)
        values = np.zeros((n, fit_kernel.PARAMETERS), np.float32)
        values[:, :3] = np.clip(surface.base_color, *options.base_color_range)
        values[:, 3], values[:, 4] = roughness, metallic
        self._texels = TexelOptimiser(surface, priors, options, values)
        self._lit = LightOptimiser(light_size, options)
        self._rotations: list[NDArray[np.float64] | None] = []  # of the fitted photos' lights
        self._normal = np.ascontiguousarray(surface.normal, np.float32)
        self._transport = np.zeros((n, fit_kernel.TRANSPORT), np.float32)
        self._transport[:, :2] = surface.occlusion[:, None]
        self._transport[:, NORMAL] = self._unit_normals
        self._step_buffers = FitStep(n)

    @property
    def _values(self) -> Floats:
        """The present values (n, PARAMETERS) of the texels."""
        return self._texels.values

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

    def rescale_metallic(self) -> None:
        """Scale metallic, where it is above .5, so that its median there is 1: metals are pure.

        Gradient steps leave it lower, as a share of diffuse reflection makes up for reflections that are misplaced.
        """
        texel = np.flatnonzero(self._values[:, 4] > 0.5)
        if len(texel):
            new = self._values[texel, :5]
            new[:, 4] = np.minimum(new[:, 4] / np.median(new[:, 4]), self._options.max_metallic)
            self._texels.reinitialise(texel, new)

    def remove_noise(self, photos: list[Pixels]) -> None:
        """Take out of metals' base colours the noise that two halves of the `photos` tell."""
        surface, metal = self._surface, (self._values[:, 4] > 0.5) & self._non_emissive()
        base = without_noise(self.metal_samples(photos), self._values, metal, surface.texels, surface.pairs)
        texel = np.flatnonzero(metal)
        self.set_materials(texel, np.column_stack([base[texel], self._values[texel, 3:5]]))

    def _non_emissive(self) -> NDArray[np.bool_]:
        """Which texels (n,) do not emit."""
        return np.asarray(self._transport[:, EMISSION].sum(1) == 0)

    def _dielectric(self) -> NDArray[np.bool_]:
        """Which texels (n,) are dielectric and do not emit."""
        return np.asarray((self._values[:, 4] < self._options.max_dielectric_metallic) & self._non_emissive())

    @property
    def mostly_dielectric(self) -> bool:
        """Whether so much is dielectric that its diffuse colours tell of the light."""
        return bool(self._dielectric().mean() >= self._options.min_dielectric_share)

    @property
    def moving_light(self) -> bool:
        """Whether the light moves from photo to photo."""
        return any(rotation is not None for rotation in self._rotations)

    @cached_property
    def _unit_normals(self) -> Floats:
        """The mesh's unit normals (n, 3) at the texels."""
        return self._normal / np.maximum(np.linalg.norm(self._normal, axis=1, keepdims=True), 1e-12)

    def _update_transport(self) -> None:
        """Visibility, indirect light and what reflections show under the present light and materials."""
        transport = self._surface.transport
        if transport is None:
            return
        visible = transport.visible_share(self._mean_radiance())
        self._transport[:, VISIBILITY] = visible
        if self._surface.indirect:
            # Albedo of both lobes together, base colour and of dielectrics F0: indirect light is not sharp enough to depend on roughness.
            reflectance = self._values[:, :3] + np.float32(0.04) * (1 - self._values[:, 4:5])
            lit = self._irradiance() * visible[:, None]
            indirect = transport.indirect_irradiance(lit, reflectance)
            self._transport[:, INDIRECT] = indirect
            metal = self._values[:, 4:5] * self._values[:, :3]
            self._transport[:, DIFFUSE] = (self._values[:, :3] - metal) * (lit + indirect)
            self._transport[:, METAL_COLOUR] = metal
            self._transport[:, ROUGHNESS], self._transport[:, METALLIC] = self._values[:, 3], self._values[:, 4]

    def _mean_radiance(self) -> Floats:
        """The environment map (6, size, size, 3) in the object's frame, the mean over photos where the light moves."""
        return mean_radiance(self._lit.radiance(), self._rotations)

    def _irradiance(self) -> Floats:
        """Irradiance / π (n, 3) of unoccluded texels, the mean over photos where the light moves."""
        return irradiance(self._mean_radiance(), self._normal)

    def _lights(self) -> PhotoLights:
        """The present light as photos see it."""
        return PhotoLights(self._lit.light.radiance().detach())

    def light_intensity(self) -> NDArray[np.float64]:
        """Mean radiance (3,) of the light over the sphere."""
        area = solid_angles(self._lit.light.size)
        return np.asarray((self._lit.radiance() * area[..., None]).sum((0, 1, 2)) / area.sum(), np.float64)

    def set_light_intensity(self, intensity: NDArray[np.float64]) -> None:
        """Scale the light to a mean radiance (3,), and base colours so that what they show stays."""
        factor = (intensity / np.maximum(self.light_intensity(), 1e-12)).astype(np.float32)
        self._change_light(EnvironmentLight.from_radiance(self._lit.radiance() * factor), np.flatnonzero(self._non_emissive()))

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

    def kind(self, metal: bool) -> float:
        """Metallic of texels that become `metal` or dielectric."""
        return self._options.detected_metallic if metal else self._options.detected_dielectric

    def _batches(self, photos: list[Pixels]) -> list[PhotoBatch]:
        return self._surface.batches(photos)

    def _samples(self, batches: list[PhotoBatch], tilted: bool = False) -> list[PhotoSamples]:
        """All pixels under the present light, with `tilted` normals as well."""
        lights, texels = self._lights(), TexelInputs.of(self._values, self._transport)
        return [b.samples(texels, lights.tables(b.to_light), tilted) for b in batches]

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
