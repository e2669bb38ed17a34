"""Searches among gradient steps for what gradients do not reach: the light's intensity and contrast, metals, and emissive regions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.materials.emission import find_emission
from gsbake.materials.light_intensity import TRIED_FACTORS, LightAdjustment, adjust_radiance, block_residual, search_light
from gsbake.materials.linear_shading import PhotoLights, PhotoSamples, linear_samples
from gsbake.materials.metallic import find_metals
from gsbake.materials.passes import Rule, Scene
from gsbake.materials.photo import Photo
from gsbake.materials.state import LIMITS, State
from gsbake.materials.surface import Materials
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import mean_radiance


@dataclass(frozen=True)
class LightScaling(Rule):
    """Scales the light to the intensity expected by the prior, and base colours with it: reflections of metal leave the scale open."""

    def applies(self, scene: Scene, state: State) -> bool:
        """On an object that is mostly metal."""
        return not state.mostly_dielectric

    @torch.no_grad()
    def run(self, scene: Scene, state: State) -> State:
        """Light and base colours scaled."""
        factor, m = 1 / state.intensity_prior.mean_factor(), state.materials
        base = np.clip(m.base_color * np.float32(factor), LIMITS.least, LIMITS.base_color[1])
        inside = Materials(base, *(np.clip(x, 1e-6, 1 - 1e-6) for x in (m.roughness, m.metallic)))
        state = state.with_light(EnvironmentLight.from_radiance(state.radiance / np.float32(factor)))
        return state.with_materials(np.arange(len(m)), inside).with_transport()


@dataclass(frozen=True)
class LightSearch(Rule):
    """Searches for the light's intensity and contrast and a roughness shift by the reflections of dielectrics (`light_intensity`); scales
    it by the prior where most is metal. Adds to the `adjustments`."""

    #: Pixels that a search uses at most: more do not change what it finds.
    pixels: int = 40_000
    #: Photos that take part where the light moves: each has tables of its own.
    moving_photos: int = 12
    #: Searches that include the light's tint on a diffuse object: its reflections hardly determine the tint, which then drifts.
    diffuse_tints: int = 2

    @torch.no_grad()
    def run(self, scene: Scene, state: State) -> State:
        """The light found, with roughness and base colours of dielectrics adapted."""
        if not state.mostly_dielectric:
            factor = np.full(3, state.intensity_prior.mean_factor())
            scaled = LightScaling().run(scene, state)
            return replace(scaled, adjustments=(*state.adjustments, LightAdjustment(factor, 1.0, 0.0, 0.0)))
        found = self._search(scene, state)
        dielectric = np.flatnonzero(state.dielectric)
        after = replace(state, adjustments=(*state.adjustments, found))
        if found.improvement <= 0:
            return after
        m = state.materials.of(dielectric)
        after = after.with_materials(dielectric, replace(m, roughness=found.shifted_roughness(m.roughness)))
        area = solid_angles(state.light.size)
        adjusted = adjust_radiance(state.radiance, found.intensity, found.contrast, area)
        return after.under_light(EnvironmentLight.from_radiance(adjusted), dielectric)

    def pixels_of(self, scene: Scene, state: State, pixels: int) -> list[Photo]:
        """Those among about so many `pixels` that show dielectric texels; of all photos, or of some where the light moves."""
        photos = [photo for photo in state.level.photos if len(photo)]
        share = min(1.0, pixels / max(1, sum(map(len, photos))))
        chosen = state.dielectric & (scene.random.random(len(state.values)) < share)
        step = -(-len(photos) // self.moving_photos) if state.level.moving else 1
        return [part for photo in photos[::step] if len(part := photo.showing(chosen))]

    def _search(self, scene: Scene, state: State) -> LightAdjustment:
        surface, subset = state.level.surface, self.pixels_of(scene, state, self.pixels)
        if not subset:
            return LightAdjustment(np.ones(3), 1.0, 0.0, 0.0)
        radiance, area = state.radiance, solid_angles(state.light.size)
        rotations = [photo.to_light for photo in state.level.photos if len(photo)]
        visible: dict[float, NDArray[np.float32]] = {}  # the share does not depend on the intensity, and hardly on the tint

        def samples_under(intensity: NDArray[np.float64], contrast: float) -> list[PhotoSamples]:
            light = EnvironmentLight.from_radiance(adjust_radiance(radiance, intensity, contrast, area)).radiance()
            transport = state.transport.copy()
            if surface.transport is not None:
                if contrast not in visible:
                    visible[contrast] = surface.transport.visible_share(mean_radiance(light.numpy(), rotations))
                transport["visibility"] = visible[contrast]
            return linear_samples(subset, state.values[:, 5:], transport, PhotoLights(light))

        tint = not scene.diffuse or len(state.adjustments) < self.diffuse_tints
        prior = replace(state.intensity_prior, metals=None)  # reflections of dielectrics tell of the light
        return search_light(samples_under, state.materials.roughness.copy(), tint, not state.adjustments, prior)


@dataclass(frozen=True)
class LightInterval(Rule):
    """Finds the factors on the light's intensity that photos and prior leave open: base colours are known to one over them only. Where most
    is metal the prior alone says so, as in the search."""

    search: LightSearch = LightSearch()
    #: Pixels that are compared: enough for an interval.
    pixels: int = 12_000

    @torch.no_grad()
    def run(self, scene: Scene, state: State) -> State:
        """The same with the `open_factors`."""
        prior, subset = state.intensity_prior, self.search.pixels_of(scene, state, self.pixels)
        if not state.mostly_dielectric or not subset:
            return replace(state, open_factors=prior.open_factors())
        lights, roughness, residuals = state.lights, state.materials.roughness.copy(), []
        for photo in subset:
            lights.tables(photo.to_light)
        for factor in TRIED_FACTORS:
            samples = linear_samples(subset, state.values[:, 5:], state.transport, lights.times(float(factor)))
            residuals.append(block_residual(samples, roughness).sum())
        return replace(state, open_factors=replace(prior, metals=None).open_factors(np.array(residuals)))


@dataclass(frozen=True)
class MetalSearch(Rule):
    """Turns texels that are detected as metal into metal, and from a metallic start those that are dielectric (`metallic`)."""

    def applies(self, scene: Scene, state: State) -> bool:
        """Not on a diffuse object."""
        return not scene.diffuse

    def run(self, scene: Scene, state: State) -> State:
        """Texels of another kind start anew; with a metallic start one that already is of its kind keeps its values."""
        m, neighbourhoods = state.materials, state.level.surface.neighbourhoods
        wide = neighbourhoods.wide  # errors of a moving light, which is an approximation, are similar all over a near one
        near = wide if state.level.moving else neighbourhoods.near(m.base_color, m.roughness)
        found = find_metals(state.metal_samples(), m.roughness.copy(), near, wide)
        kinds = [(found.texel, found.base, found.roughness, LIMITS.as_metal)]
        if state.from_metal:
            kinds.append((*found.dielectric, LIMITS.as_dielectric))
        for texel, base, roughness, metallic in kinds:
            is_metal = state.values[texel, 4] > LIMITS.metal
            other = is_metal != (metallic > LIMITS.metal) if state.from_metal else np.ones(len(texel), bool)
            new = Materials(np.clip(base, *LIMITS.base_color)[other], roughness[other], np.full(int(other.sum()), metallic))
            state = state.with_materials(texel[other], new)
        return state


@dataclass(frozen=True)
class EmissionSearch(Rule):
    """Finds emissive regions (`emission`), sets their radiance, and makes their base colour black."""

    def run(self, scene: Scene, state: State) -> State:
        """Emissive texels with their radiance."""
        surface, roughness = state.level.surface, state.materials.roughness.copy()
        found = find_emission(state.samples(state.level.photos), roughness, surface.pairs, np.asarray(surface.position, np.float64))
        transport = state.transport.copy()
        transport["emission"][found.texel] = found.radiance
        black = Materials(
            np.full((len(found.texel), 3), LIMITS.base_color[0], np.float32), roughness[found.texel],
            np.full(len(found.texel), LIMITS.as_dielectric, np.float32),
        )  # fmt: skip
        return replace(state.with_materials(found.texel, black), transport=transport, emissive_regions=found.regions)
