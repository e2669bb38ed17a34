"""The state of a material fit: texels, light, and what follows from them. States do not change; what a pass does is another state.

Visibility of the light, indirect light and what reflections show follow from texels and light, and are updated every few steps without
gradient (`visibility`), so that neither shadows nor interreflections end up in base colour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.metrics import decibels
from gsbake.materials import fit_kernel
from gsbake.materials.light_intensity import IntensityPrior, LightAdjustment
from gsbake.materials.linear_shading import PhotoLights, PhotoSamples, Records, ShadingStep, linear_samples
from gsbake.materials.photo import Photo
from gsbake.materials.surface import Materials, Surface
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import LightMotion, mean_radiance
from gsbake.shading.light_tables import irradiance
from gsbake.texturing.resampling import CoarseTexture

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Limits:
    """Ranges of materials, and from where on a texel counts as one kind."""

    #: Linear base colour at the start and after searches, and after a change of the light; logits stay finite.
    base_color: tuple[float, float] = (0.01, 0.95)
    least: float = 1e-3
    #: Texels below this metallic take part as dielectric where the light is searched for, those above the second are metal.
    dielectric: float = 0.3
    metal: float = 0.5
    #: Metallic of texels that become dielectric or metal, from where gradient steps go on, and the highest of pure metals.
    as_dielectric: float = 0.05
    as_metal: float = 0.9
    pure_metal: float = 0.99
    #: Least share of dielectric texels for their diffuse colours to tell of the light: reflections of metal do not tell its intensity.
    dielectric_share: float = 0.5
    #: Pixels per texel, of all photos together, that searches for metals use: neighbouring texels decide together.
    metal_pixels: int = 3
    #: Pseudo-Huber scale in sRGB values (0..1) where fits are compared: small, as misplaced highlights would decide, which a blurred light
    #: avoids and a sharp one does not.
    comparison_scale: float = 0.02


LIMITS = Limits()


@dataclass(frozen=True)
class Finer:
    """A finer `level`, whose texels `texture` reduces to those of the present one."""

    level: Level
    texture: CoarseTexture


@dataclass(frozen=True)
class Level:
    """One resolution of the fit: the texels of its `surface`, the `photos` to fit, and those for `validation`; and the next `finer` one."""

    surface: Surface
    photos: list[Photo]
    validation: list[Photo]
    finer: Finer | None = None

    @property
    def validated(self) -> bool:
        """Whether there are validation photos."""
        return any(map(len, self.validation))

    @property
    def moving(self) -> bool:
        """Whether the light moves from photo to photo."""
        return any(photo.to_light is not None for photo in self.photos)

    def under(self, rotations: Doubles | None) -> Level:
        """The same under a light that is turned for each photo of the capture by `rotations` (photos, 3, 3); None: it stands."""
        if rotations is None:
            return self
        photos, validation = ([replace(p, to_light=rotations[p.index]) for p in role] for role in (self.photos, self.validation))
        return replace(self, photos=photos, validation=validation)


@dataclass(frozen=True)
class State:
    """Texels and light of a fit on a `level`, with the moments of their optimisers.

    `values` (n, PARAMETERS) are what `materials` names, `logits` their logits (normal offsets as they are), `moments` Adam's two, after
    `steps`; `transport` (n,) of `fit_kernel.TRANSPORT`; `light` with Adam's moments and steps, None: none yet. `from_metal`: all texels
    started as metal; `light_given`: gradient steps leave the light as it is; `adjustments`, one per search for the light. `error` and
    `psnr` on the validation photos when last judged: mean robust error, 0 without any, and dB, None without any.

    What passes found: the metallic and roughness of the `chosen_start` and the `evidence`; the light's mean `intensity` (3,) after
    searches, and the least and the largest of the `open_factors` on it; whether texels' `kinds_changed` since; how the light moves; the
    materials `selected` for the asset, and the `maps` made of them at its texels.
    """

    level: Level
    values: Floats
    logits: Floats
    moments: tuple[Floats, Floats]
    steps: int
    transport: Records
    light: EnvironmentLight
    light_moments: tuple[torch.Tensor, torch.Tensor, int] | None = None
    from_metal: bool = False
    light_given: bool = False
    adjustments: tuple[LightAdjustment, ...] = ()
    emissive_regions: int = 0
    error: float = 0.0
    psnr: float | None = None
    chosen_start: tuple[float, float] = (0.0, 0.0)
    evidence: str = ""
    intensity: Doubles | None = None
    open_factors: tuple[float, float] | None = None
    kinds_changed: bool = False
    light_motion: LightMotion = LightMotion()
    selected: Materials | None = None
    maps: Materials | None = None

    @classmethod
    def start(cls, level: Level, light_size: int, roughness: float, metallic: float = LIMITS.as_dielectric) -> State:
        """All texels with one `roughness` and `metallic` in the projected colours, under an even light of `light_size` texels' edge."""
        surface, n = level.surface, len(level.surface.texels)
        transport = np.zeros(n, fit_kernel.TRANSPORT)
        transport["visibility"] = transport["occlusion"] = surface.occlusion
        transport["normal"] = surface.unit_normals
        values = np.zeros((n, fit_kernel.PARAMETERS), np.float32)
        values[:, :3] = np.clip(surface.base_color, *LIMITS.base_color)
        values[:, 3], values[:, 4] = roughness, metallic
        from_metal = metallic > LIMITS.dielectric
        return cls._of(level, values, transport, EnvironmentLight(light_size), from_metal)

    @classmethod
    def _of(cls, level: Level, values: Floats, transport: Records, light: EnvironmentLight, from_metal: bool) -> State:
        logits = values.copy()
        logits[:, :5] = _logit(values[:, :5])
        return cls(level, values, logits, (np.zeros_like(values), np.zeros_like(values)), 0, transport, light, from_metal=from_metal)

    def on(self, level: Level, values: Floats, emission: Floats) -> State:
        """The fit on the texels of another `level`, which start with `values` (n, PARAMETERS) and `emission` (n, 3)."""
        start = State.start(level, self.light.size, 0.5)
        start.transport["emission"] = emission
        started = State._of(level, values, start.transport, copied(self.light), self.from_metal)
        kept = (
            "light_given", "adjustments", "emissive_regions", "chosen_start", "evidence", "intensity", "open_factors", "kinds_changed",
            "light_motion",
        )  # fmt: skip
        return replace(started, **{name: getattr(self, name) for name in kept})

    @property
    def materials(self) -> Materials:
        """The materials of the texels."""
        v = self.values
        return Materials(v[:, :3], v[:, 3], v[:, 4], normal_offset=v[:, 5:], emission=self.transport["emission"])

    @property
    def metal(self) -> Mask:
        """Which texels (n,) are metallic."""
        return np.asarray(self.values[:, 4] > LIMITS.metal)

    @property
    def emits_nothing(self) -> Mask:
        """Which texels (n,) do not emit."""
        return np.asarray(self.transport["emission"].sum(1) == 0)

    @property
    def dielectric(self) -> Mask:
        """Which texels (n,) are dielectric and do not emit."""
        return np.asarray((self.values[:, 4] < LIMITS.dielectric) & self.emits_nothing)

    @property
    def mostly_dielectric(self) -> bool:
        """Whether so much is dielectric that its diffuse colours tell of the light."""
        return bool(self.dielectric.mean() >= LIMITS.dielectric_share)

    @property
    def radiance(self) -> Floats:
        """The environment map (6, size, size, 3), linear RGB."""
        return np.asarray(self.light.radiance().detach().numpy())

    def with_materials(self, texel: Indices, new: Materials) -> State:
        """The texels (m,) with the materials `new` of m texels; the optimiser's moments start anew there."""
        values, logits, moments = self.values.copy(), self.logits.copy(), (self.moments[0].copy(), self.moments[1].copy())
        values[texel, :3], values[texel, 3], values[texel, 4] = new.base_color, new.roughness, new.metallic
        logits[texel, :5] = _logit(values[texel, :5])
        for moment in moments:
            moment[texel, :5] = 0
        return replace(self, values=values, logits=logits, moments=moments)

    def with_inside(self, texel: Indices, new: Materials) -> State:
        """The same with the materials within the range of logits."""
        tiny = LIMITS.least
        return self.with_materials(texel, Materials(*(np.clip(x, tiny, 1 - tiny) for x in (new.base_color, new.roughness, new.metallic))))

    def with_light(self, light: EnvironmentLight) -> State:
        """The same under another `light`, whose optimiser starts anew."""
        return replace(self, light=light, light_moments=None)

    def with_transport(self) -> State:
        """The same with visibility, indirect light and what reflections show under the present light and materials."""
        source, surface = self.level.surface.transport, self.level.surface
        if source is None:
            return self
        transport, m = self.transport.copy(), self.materials
        visible = source.visible_share(self.mean_radiance)
        transport["visibility"] = visible
        if surface.indirect:
            # Albedo of both lobes together, base colour and of dielectrics F0: indirect light is not sharp enough to depend on roughness.
            reflectance = m.base_color + np.float32(0.04) * (1 - m.metallic[:, None])
            lit = self._irradiance() * visible[:, None]
            indirect = source.indirect_irradiance(lit, reflectance)
            metal = m.metallic[:, None] * m.base_color
            transport["indirect"], transport["metal_colour"] = indirect, metal
            transport["diffuse"] = (m.base_color - metal) * (lit + indirect)
            transport["roughness"], transport["metallic"] = m.roughness, m.metallic
        return replace(self, transport=transport)

    @property
    def mean_radiance(self) -> Floats:
        """The environment map (6, size, size, 3) in the object's frame, the mean over photos where the light moves."""
        return mean_radiance(self.radiance, [photo.to_light for photo in self.level.photos if len(photo)])

    def _irradiance(self) -> Floats:
        """Irradiance / π (n, 3) of unoccluded texels, the mean over photos where the light moves."""
        return irradiance(self.mean_radiance, self.level.surface.normal)

    @torch.no_grad()
    def under_light(self, light: EnvironmentLight, texel: Indices) -> State:
        """Another `light`, and the base colours of the texels (m,) changed so that their diffuse colours stay."""
        before = self._irradiance() * self.transport["visibility"][:, None] + self.transport["indirect"]
        state = self.with_light(light).with_transport()
        after = state._irradiance() * state.transport["visibility"][:, None] + state.transport["indirect"]
        m = state.materials.of(texel)
        base = np.clip(m.base_color * before[texel] / np.maximum(after[texel], 1e-6), LIMITS.least, LIMITS.base_color[1])
        return state.with_materials(texel, replace(m, base_color=base))

    def restarted(self) -> State:
        """The same with the optimisers' moments anew, materials within the range of logits, and what follows from them."""
        return self.with_light(self.light).with_inside(np.arange(len(self.values)), self.materials).with_transport()

    @property
    def mean_intensity(self) -> Doubles:
        """Mean radiance (3,) of the light over the sphere."""
        area = solid_angles(self.light.size)
        return np.asarray((self.radiance * area[..., None]).sum((0, 1, 2)) / area.sum(), np.float64)

    @property
    def intensity_prior(self) -> IntensityPrior:
        """The prior of the present intensity of the light."""
        return IntensityPrior.of(self.materials, self.dielectric, None if self.level.moving else self.mean_radiance)

    @property
    def lights(self) -> PhotoLights:
        """The present light as photos see it."""
        return PhotoLights(self.light.radiance().detach())

    def samples(self, photos: list[Photo], tilted: bool = False) -> list[PhotoSamples]:
        """The pixels of `photos` for searches under the present light, with `tilted` normals as well."""
        return linear_samples(filter(len, photos), self.values[:, 5:], self.transport, self.lights, tilted)

    def metal_samples(self, part: slice = slice(None)) -> list[PhotoSamples]:
        """The pixels that a search for metals uses in `part` of the photos, with tilted normals, under the present light."""
        photos = [photo for photo in self.level.photos if len(photo)]
        step = max(1, sum(map(len, photos)) // (LIMITS.metal_pixels * len(self.values)))
        return self.samples([photo.every(step) for photo in photos[part]], tilted=True)

    def decibels(self, photos: list[Photo], materials: Materials | None = None) -> float | None:
        """PSNR in dB over all pixels of `photos` (None without any), with the fitted `materials` or with others."""
        found = self._errors(photos, materials)
        return None if found is None else decibels(found[1])

    def judged(self) -> State:
        """The same with its errors on validation photos."""
        found = self._errors(self.level.validation, None)
        return replace(self, error=0.0, psnr=None) if found is None else replace(self, error=found[0], psnr=decibels(found[1]))

    def _errors(self, photos: list[Photo], materials: Materials | None) -> tuple[float, float] | None:
        """Mean robust and mean squared error over all pixels of `photos`; None without any."""
        shown = [replace(photo, weight=np.ones_like(photo.weight)) for photo in photos if len(photo)]
        if not shown:
            return None
        values = self.values
        if materials is not None:
            values = np.column_stack([materials.base_color, materials.roughness, materials.metallic, self.values[:, 5:]]).astype(np.float32)
        lights, shade = self.lights, ShadingStep(len(values))
        sums = np.sum(
            [shade(p, values, lights.tables(p.to_light), self.transport, 1.0, LIMITS.comparison_scale, 0.0) for p in shown], axis=0
        )
        return float(sums[0] / sums[2]), float(sums[1] / sums[2])


def copied(light: EnvironmentLight) -> EnvironmentLight:
    """A copy of the `light`, for an optimiser to change."""
    out = EnvironmentLight(light.size)
    with torch.no_grad():
        out.raw.copy_(light.raw)
    return out


def _logit(values: Floats) -> Floats:
    """log(v / (1 − v)) of values in (0, 1)."""
    v = np.asarray(values, np.float64)
    return np.asarray(np.log(v / (1 - v)), np.float32)
