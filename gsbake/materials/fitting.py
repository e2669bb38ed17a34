"""Material textures of an unwrapped mesh: read pixels, trace visibility, fit materials and light, select maps, add fine detail.

The fit works on two levels (`levels`): starts are compared and searches made on the coarse one, and the fine one continues from the best.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.roles import held_out, test_photos, validation_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.view_dependence import is_diffuse
from gsbake.config.schema import Bake
from gsbake.geometry.cameras import Camera
from gsbake.materials.adjacency import neighbours
from gsbake.materials.fit_surface import FitSurface, Fitted
from gsbake.materials.initialisation import ChosenFit
from gsbake.materials.levels import FitLevel, InterpolatedTransport, coarse_pixels, coarse_surface
from gsbake.materials.map_selection import drop_unneeded_maps
from gsbake.materials.metal_superresolution import superresolve_metals
from gsbake.materials.options import Priors
from gsbake.materials.pixels import PixelReader, Pixels
from gsbake.materials.reflections import ReflectionTracer
from gsbake.materials.two_level_fit import FitPlan, compare_light_motions, fit_two_levels
from gsbake.materials.view_dependence import SURFACE_POINTS, MeshBrightness
from gsbake.materials.visibility import Visibility
from gsbake.meshing.resolution import pixel_footprint
from gsbake.monitor import Monitor, PartSequence, Rule, decide_skip, skips
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import LightMotion, Motion, light_rotations
from gsbake.texturing.normal_map import DenseSamples
from gsbake.texturing.projection import ProjectedTexture
from gsbake.texturing.resampling import MIN_SIZE, CoarseTexture
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh
from gsbake.texturing.usable_pixels import UsablePixels

Floats = NDArray[np.float32]

#: Height of ray origins above the surface, as a share of the diagonal, against self-intersection.
RAY_OFFSET = 0.002
#: Radius of the filter for ray-traced values, in texels.
SMOOTHING_RADIUS = 3.0
#: Largest number of pixels of each photo that materials are fitted to.
MAX_PIXELS = 60_000
#: A light is taken to move where that lowers the validation error by this share (.04 on a set where it stands, .13 on a turntable).
MIN_MOTION_GAIN = 0.08
#: What a light does, in words.
_MOTIONS = {"static": "stands", "turntable": "turns with the cameras (turntable)", "camera": "moves with the camera"}
#: Least weight of a texel, in frontal views at a texel's size, for its normal to be refined and for it to count as observed.
MIN_OBSERVATIONS = 0.3


@dataclass(frozen=True)
class FitSettings:
    """Settings of the material fit; `light_size` is the edge of the environment map's faces in texels, `holdout` that of training, the rest
    are rules of [skip]."""

    bake: Bake = Bake()
    light_size: int = 32
    holdout: int = 8
    specular: Rule = "auto"
    metallic_map: Rule = "auto"
    roughness_map: Rule = "auto"


@dataclass(frozen=True)
class FittedTextures:
    """`textures`: base colour, roughness, metallic (n, 5), with emission (n, 8) where there is any; `normal` of the texels; the `light` in
    the unit frame, where it moves as the first photo saw it; `figures` for the manifest; how the light moves."""

    textures: ProjectedTexture
    normal: DenseSamples
    light: EnvironmentLight
    figures: dict[str, Any]
    light_motion: LightMotion = LightMotion()


def fit_materials(
    surface: UnwrappedMesh,
    posed: PosedPhotos,
    projected: ProjectedTexture,
    detail: DenseSamples,
    occlusion: Floats,
    settings: FitSettings,
    seed: int,
    monitor: Monitor,
) -> FittedTextures:
    """Base colour, roughness, metallic, emission, normals and light that reproduce the photos.

    `projected` (n, 3) are the photos' colours on the texture: the initial base colour and, where the fit works on a coarser texture, its
    fine detail. `detail` and `occlusion` (n,) are the dense mesh's normals and ambient occlusion at the texels.
    """
    return _Fitting(surface, posed, projected, detail, occlusion, settings, seed, monitor).run()


@dataclass(frozen=True)
class _PhotoPixels:
    """Pixels of the photos to fit with their `cameras`, of those that decisions look at and of those that nothing looks at, whether the
    surface is `diffuse`, the `evidence`, and the `indices` of the photos in the three roles."""

    fitted: list[Pixels]
    cameras: list[Camera]
    validation: list[Pixels]
    test: list[Pixels]
    diffuse: bool
    evidence: str
    indices: tuple[list[int], list[int], list[int]]

    def under(self, rotations: NDArray[np.float64] | None) -> _PhotoPixels:
        """The same under a light that is turned for each photo of the capture by `rotations` (photos, 3, 3); None: it stands."""
        if rotations is None:
            return self
        roles = zip((self.fitted, self.validation, self.test), self.indices, strict=True)
        fitted, validation, test = ([replace(p, to_light=rotations[i]) for p, i in zip(*role, strict=True)] for role in roles)
        return replace(self, fitted=fitted, validation=validation, test=test)


@dataclass
class _Fitting:
    """One run; `n` texels of the full texture, `m` of the coarse one that the fit works on."""

    surface: UnwrappedMesh
    posed: PosedPhotos
    projected: ProjectedTexture
    detail: DenseSamples
    occlusion: Floats
    settings: FitSettings
    seed: int
    monitor: Monitor
    light_motion: LightMotion = LightMotion()

    def run(self) -> FittedTextures:
        """Choose the texture size, read the photos' pixels, trace visibility, fit, and resample to the full texture."""
        with PartSequence(self.monitor) as self.parts:
            self.parts.start("light transport")
            footprint = self._choose_texture()
            pixels = self._read_pixels()
            fine, coarse = self._surfaces()
            diffuse = skips(self.settings.specular, pixels.diffuse)
            if fine.transport is not None and self.settings.bake.visibility == "reflections" and not diffuse:
                pixels = self._trace_reflections(pixels, fine)
            pixels = self._under_moving_light(coarse, pixels, diffuse)
            choice = self._fit(fine, coarse, pixels, diffuse)
            self.parts.start("full texture")
            values = self._full_texture(choice, pixels)
            return self._result(choice, values, footprint, pixels)

    @property
    def _ray_offset(self) -> float:
        """Height of ray origins above the surface, in mesh units."""
        return RAY_OFFSET * self.surface.diagonal

    def _choose_texture(self) -> float:
        """Choose the coarse texture, whose texels are about a pixel of the photos wide; returns that width in mesh units."""
        surface = self.surface
        cameras = [camera.downscaled_to(self.settings.bake.fit_size) for camera in self.posed.cameras.cameras]
        footprint = pixel_footprint(cameras, surface.position.mean(0))
        self.coarse = CoarseTexture.of(surface.atlas.uv, surface.atlas.faces, surface.texels, surface.texel_size, footprint)
        size = self.coarse.texels.size
        half = max(MIN_SIZE, size // 2)
        self.half = CoarseTexture.sized(surface.atlas.uv, surface.atlas.faces, self.coarse.texels, self.coarse.edge, half)
        self.monitor.decide("fit texture", f"{size}² texels", f"texel width {self.coarse.edge / footprint:.2f} pixels")
        return footprint

    def _read_pixels(self) -> _PhotoPixels:
        """Read the pixels of all photos, exposure gains divided out, and measure view dependence."""
        surface, settings = self.surface, self.settings
        reader = PixelReader(surface.atlas_caster, surface.atlas.uv, self.coarse.texels, surface.diagonal)
        count, usable = len(self.posed), UsablePixels(self.posed)
        validation, test = (set(roles(count, settings.holdout)) for roles in (validation_photos, test_photos))
        points = slice(None, None, max(1, len(surface.texel_position) // SURFACE_POINTS))
        brightness = MeshBrightness(surface.texel_position[points], surface.texel_normal[points], surface.caster, surface.diagonal)
        pixels: list[Pixels] = []
        cameras: list[Camera] = []
        for index in range(count):
            self.monitor.check_stop()
            view = self.posed.view(index, settings.bake.fit_size)
            brightness.add(view)
            read = reader.read(view.camera, view.rgb, usable.mask(index, view)).subsampled(MAX_PIXELS)
            pixels.append(read.without_gain(self.projected.gains[index]))
            cameras.append(view.camera)
        fitted = sorted(set(range(count)) - validation - test)
        indices = (fitted, sorted(validation), sorted(test))
        photos, chosen, untouched = ([pixels[i] for i in role] for role in indices)
        self.cameras = cameras
        return _PhotoPixels(photos, [cameras[i] for i in fitted], chosen, untouched, *is_diffuse(*brightness.statistics()), indices)

    def _trace_reflections(self, pixels: _PhotoPixels, texels: FitSurface) -> _PhotoPixels:
        """The pixels with the texels that their reflected rays hit."""
        caster, uv = self.surface.atlas_caster, self.surface.atlas.uv
        tracer = ReflectionTracer(caster, uv, texels.texels, texels.position, texels.normal, self._ray_offset)
        fitted, validation, test = ([*map(tracer.trace, photos)] for photos in (pixels.fitted, pixels.validation, pixels.test))
        return replace(pixels, fitted=fitted, validation=validation, test=test)

    def _surfaces(self) -> tuple[FitSurface, FitSurface]:
        """The texels of the fine and of the coarse level: geometry, ambient occlusion, light transport and initial base colour."""
        surface, texture, settings = self.surface, self.coarse, self.settings.bake
        normal, occlusion, base = (texture.down(x) for x in (self.detail.normal, self.occlusion[:, None], self.projected.values))
        position = texture.texels.interpolate(surface.position, surface.atlas.faces)
        if settings.visibility == "none":
            occlusion = np.ones_like(occlusion)
        pairs, indirect = neighbours(texture.texels, position, normal), settings.visibility in ("bounce", "reflections")
        fine = FitSurface(texture.texels, position, pairs, normal, occlusion[:, 0], base, None, indirect)
        coarse = coarse_surface(fine, self.half)
        if settings.visibility == "none" or not settings.occlusion_rays:
            return fine, coarse
        radius, rays = SMOOTHING_RADIUS * self.half.edge, 2 * settings.occlusion_rays  # over the whole sphere
        transport = Visibility.trace(
            coarse.texels, surface.atlas.uv, surface.atlas_caster, coarse.normal, rays, self._ray_offset, radius,
            lambda *_: self.monitor.check_stop(),
        )  # fmt: skip
        return replace(fine, transport=InterpolatedTransport(transport, self.half)), replace(coarse, transport=transport)

    def _plan(self, diffuse: bool) -> FitPlan:
        settings = self.settings.bake
        return FitPlan(settings.fit_iterations, self.settings.light_size, Priors.of(settings), self.seed, diffuse)

    def _each(self, name: str, done: int, total: int) -> None:
        self.monitor.check_stop()
        self.parts.start(name)
        self.monitor.progress(done, total, name)

    def _coarse_level(self, texels: FitSurface, pixels: _PhotoPixels) -> FitLevel:
        """The coarse level. Few photos are held out, so it adds some of those to fit to the validation photos; the fine level fits them."""
        reduce = partial(coarse_pixels, texture=self.half)
        photos, validation = [*map(reduce, pixels.fitted)], [*map(reduce, pixels.validation)]
        added = set(held_out(len(photos), self.settings.holdout)) if validation else set()
        kept = [p for i, p in enumerate(photos) if i not in added]
        return FitLevel(texels, kept, validation + [photos[i] for i in sorted(added)])

    def _under_moving_light(self, texels: FitSurface, pixels: _PhotoPixels, diffuse: bool) -> _PhotoPixels:
        """The pixels under the light that moves as `bake.light_motion` says, or as explains the validation photos best."""
        asked = self.settings.bake.light_motion
        if asked == "auto" and (diffuse or not any(map(len, pixels.validation))):
            return pixels
        motions: tuple[Motion, ...] = ("turntable", "camera") if asked == "auto" else (asked,)
        under = {motion: r for motion in motions if (r := light_rotations(self.cameras, motion)) is not None}
        if asked != "auto":
            if asked != "static" and not under:
                self.monitor.warn(f"bake.light_motion is {asked}, but the cameras do not turn about one axis; the light is taken to stand.")
            self.light_motion = LightMotion(asked if under else "static", under.get(asked))
            self.monitor.decide("light", _MOTIONS[self.light_motion.motion], "bake.light_motion")
            return pixels.under(self.light_motion.rotations)
        if not under:
            return pixels
        levels: dict[Motion, FitLevel] = {"static": self._coarse_level(texels, pixels)}
        levels |= {motion: self._coarse_level(texels, pixels.under(rotations)) for motion, rotations in under.items()}
        errors = compare_light_motions(levels, self._plan(diffuse), self._each)
        best = min(errors, key=lambda motion: errors[motion] * (1 - MIN_MOTION_GAIN if motion == "static" else 1))
        self.light_motion = LightMotion(best, under.get(best))
        self.monitor.decide("light", _MOTIONS[best], ", ".join(f"{error:.2%} error where it {_MOTIONS[m]}" for m, error in errors.items()))
        return pixels.under(self.light_motion.rotations)

    def _fit(self, fine_texels: FitSurface, coarse_texels: FitSurface, pixels: _PhotoPixels, diffuse: bool) -> ChosenFit:
        """Compare starts on the coarse level, and fit the fine one from the best; `diffuse`: without specular reflection."""
        fine, plan = FitLevel(fine_texels, pixels.fitted, pixels.validation), self._plan(diffuse)
        started = time.perf_counter()
        choice = fit_two_levels(self._coarse_level(coarse_texels, pixels), fine, self.half, plan, self._each)
        seconds = time.perf_counter() - started
        self._report(choice, pixels, 0.0 if diffuse else seconds)
        return choice

    def _report(self, choice: ChosenFit, pixels: _PhotoPixels, saved: float) -> None:
        """Report the decisions of the fit; skipping specular reflection would have `saved` so many seconds."""
        monitor, fitted = self.monitor, choice.fitted
        monitor.decide("initial material", f"metallic {choice.metallic:g}, roughness {choice.roughness:g}", choice.evidence)
        skipped, done = "diffuse object", "specular reflection fitted"
        decide_skip(monitor, "specular", self.settings.specular, pixels.diffuse, pixels.evidence, skipped, done, saved)
        adjustments = "; ".join(map(str, fitted.light_adjustments))
        monitor.decide("light intensity", adjustments, "lowest residual with the best base colours")
        monitor.decide("emission", f"{fitted.emissive_regions} regions", "bright, bounded by an edge, and independent of irradiance")

    def _full_texture(self, choice: ChosenFit, pixels: _PhotoPixels) -> Floats:
        """The fitted values at all texels (n, 5 or 8), without the maps that are not needed, with fine detail."""
        coarse, settings, fit, fitted = self.coarse, self.settings, choice.fit, choice.fitted
        detail = coarse.detail(self.projected.values)
        validation = pixels.validation if any(map(len, pixels.validation)) else pixels.fitted
        rules = {"metallic_map": settings.metallic_map, "roughness_map": settings.roughness_map}

        def decide(name: str, holds: bool, evidence: str, skipped: str, done: str) -> bool:
            return decide_skip(self.monitor, name, rules[name], holds, evidence, skipped, done)

        metal = _metals(fitted)
        selected = drop_unneeded_maps(fitted.values, fitted.weight, int(metal.sum()), partial(fit.psnr, validation), decide)
        values = coarse.up(selected)
        values[:, :3] *= detail
        if metal.any() and selected[:, 4].any():
            photos = list(zip(pixels.fitted, pixels.cameras, strict=True))
            values = superresolve_metals(self.surface, coarse, fit, metal, selected[:, 3], values, photos)
        if fitted.emissive_regions:
            values = np.concatenate([values, coarse.up(fitted.emission) * detail], 1)
        return values

    def _result(self, choice: ChosenFit, values: Floats, footprint: float, pixels: _PhotoPixels) -> FittedTextures:
        """Textures, refined normals, light and figures; `fit_psnr` is that on test photos."""
        coarse, fitted = self.coarse, choice.fitted
        observed = coarse.up(fitted.weight[:, None])[:, 0] > MIN_OBSERVATIONS * (coarse.edge / footprint) ** 2
        normal = self.detail.normal + np.where(observed[:, None], coarse.up(fitted.normal_offset), 0)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        figures: dict[str, Any] = {
            "fit_psnr": choice.fit.psnr(pixels.test),
            "fit_pixels": sum(map(len, pixels.fitted)),
            "fit_texels": len(coarse.texels),
            "fit_metal_texels": int(_metals(fitted).sum()),
            "fit_emissive_regions": fitted.emissive_regions,
        }
        textures = replace(self.projected, values=values, views=np.where(observed, self.projected.views, 0))
        return FittedTextures(textures, replace(self.detail, normal=normal), fitted.light, figures, self.light_motion)


def _metals(fitted: Fitted) -> NDArray[np.bool_]:
    """Which texels (n,) are metallic."""
    return np.asarray(fitted.values[:, 4] > 0.5)
