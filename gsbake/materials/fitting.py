"""The material fit of an unwrapped mesh, from photos to textures: pixels read, visibility traced, the fit run, maps selected."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.view_dependence import looks_diffuse
from gsbake.config.schema import Bake
from gsbake.geometry.cameras import Camera
from gsbake.materials.adjacency import neighbours
from gsbake.materials.fit import FitSurface, MaterialFit, Priors
from gsbake.materials.initialisation import Choice, best_fit, trial_cost, trial_roughness
from gsbake.materials.map_selection import plainer
from gsbake.materials.metal_superresolution import sharp_metals
from gsbake.materials.pixels import PixelReader, Pixels
from gsbake.materials.reflections import Mirrors
from gsbake.materials.view_dependence import PLACES, MeshWatch
from gsbake.materials.visibility import Visibility
from gsbake.meshing.resolution import pixel_footprint
from gsbake.monitor import Monitor, Rule, decide_skip, skips
from gsbake.shading.environment import EnvironmentLight
from gsbake.surfels.training.views import held_out
from gsbake.texturing.normal_map import Detail
from gsbake.texturing.projection import Blended
from gsbake.texturing.resampling import Coarse
from gsbake.texturing.unwrapped_mesh import Surface

Floats = NDArray[np.float32]

#: Occlusion rays start this share of the diagonal above the surface; traced values are averaged within this many texels.
RAY_OFFSET, SMOOTHING_RADIUS = 0.002, 3.0
#: Materials are fitted to at most this many pixels of each photo.
MAX_PIXELS = 60_000
#: A texel counts as observed where the photos together saw it as well as this many frontal views do; others are inpainted.
MIN_OBSERVATIONS = 0.3


@dataclass(frozen=True)
class FitOptions:
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
    the unit frame; `figures` for the manifest."""

    textures: Blended
    normal: Detail
    light: EnvironmentLight
    figures: dict[str, Any]


def fit_materials(
    surface: Surface,
    posed: PosedPhotos,
    projected: Blended,
    detail: Detail,
    occlusion: Floats,
    options: FitOptions,
    seed: int,
    monitor: Monitor,
) -> FittedTextures:
    """Base colour, roughness, metallic, emission, normals and light that reproduce the photos.

    `projected` (n, 3) are the photos' colours on the texture: the initial base colour and, where the fit works on a coarser texture, its
    fine detail. `detail` and `occlusion` (n,) are the dense mesh's normals and ambient occlusion at the texels.
    """
    return _Fitting(surface, posed, projected, detail, occlusion, options, seed, monitor).run()


@dataclass
class _Fitting:
    """One run; `n` texels of the full texture, `m` of the coarse one that the fit works on."""

    surface: Surface
    posed: PosedPhotos
    projected: Blended
    detail: Detail
    occlusion: Floats
    options: FitOptions
    seed: int
    monitor: Monitor

    def run(self) -> FittedTextures:
        """The recipe."""
        footprint = self._choose_texture()
        photos, held, cameras, diffuse, evidence = self._read_pixels()
        texels = self._texels()
        diffuse_object = skips(self.options.specular, diffuse)
        if texels.visibility is not None and self.options.bake.visibility == "reflections" and not diffuse_object:
            mirrors = Mirrors(self.surface.whole, self.surface.atlas.uv, texels.texels, texels.position, texels.normal, self._offset)
            photos, held = ([mirrors.traced(pixels) for pixels in part] for part in (photos, held))
        choice = self._fit(texels, photos, held, diffuse_object, diffuse, evidence)
        values = self._full_texture(choice, photos, held, cameras)
        return self._result(choice, values, footprint, photos)

    @property
    def _offset(self) -> float:
        """Where rays start above the surface, in mesh units."""
        return RAY_OFFSET * self.surface.diagonal

    def _choose_texture(self) -> float:
        """Choose the coarse texture, whose texels are about a pixel of the photos wide; returns that width in mesh units."""
        surface = self.surface
        cameras = [camera.within(self.options.bake.fit_size) for camera in self.posed.cameras.cameras]
        footprint = pixel_footprint(cameras, surface.position.mean(0))
        self.coarse = Coarse.of(surface.atlas.uv, surface.atlas.faces, surface.texels, surface.texel, footprint)
        size = self.coarse.texels.size
        self.monitor.decide("fit texture", f"{size}² texels", f"a texel is {self.coarse.edge / footprint:.2f} pixels of the photos")
        return footprint

    def _read_pixels(self) -> tuple[list[Pixels], list[Pixels], list[Camera], bool, str]:
        """Pixels of the photos to fit and of those held out, cameras of the former, whether the surface looks diffuse, and the evidence."""
        surface, options = self.surface, self.options
        reader = PixelReader(surface.whole, surface.atlas.uv, self.coarse.texels, surface.diagonal)
        aside = set(held_out(len(self.posed), options.holdout))
        some = slice(None, None, max(1, len(surface.at) // PLACES))
        watch = MeshWatch(surface.at[some], surface.facing[some], surface.caster, surface.diagonal)
        photos: list[Pixels] = []
        held: list[Pixels] = []
        cameras: list[Camera] = []
        for index in range(len(self.posed)):
            self.monitor.check_stop()
            view = self.posed.view(index, options.bake.fit_size)
            watch.add(view)
            pixels = reader.read(view.camera, view.rgb, view.mask).thinned(MAX_PIXELS)
            (held if index in aside else photos).append(pixels.without_gain(self.projected.gains[index]))
            cameras += [] if index in aside else [view.camera]
        return photos, held, cameras, *looks_diffuse(*watch.changes())

    def _texels(self) -> FitSurface:
        """The coarse texels with what the fit knows of them."""
        surface, coarse, settings = self.surface, self.coarse, self.options.bake
        normal, occlusion, base = (coarse.down(x) for x in (self.detail.normal, self.occlusion[:, None], self.projected.values))
        position = coarse.texels.interpolate(surface.position, surface.atlas.faces)
        visibility = None
        if settings.visibility in ("directional", "bounce", "reflections") and settings.occlusion_rays:
            radius, rays = SMOOTHING_RADIUS * coarse.edge, 2 * settings.occlusion_rays  # over the whole sphere
            visibility = Visibility.trace(
                coarse.texels, surface.atlas.uv, surface.whole, normal, rays, self._offset, radius, lambda *_: self.monitor.check_stop()
            )
        if settings.visibility == "none":
            occlusion = np.ones_like(occlusion)
        pairs = neighbours(coarse.texels, position, normal)
        indirect = settings.visibility in ("bounce", "reflections")
        return FitSurface(coarse.texels, position, pairs, normal, occlusion[:, 0], base, visibility, indirect)

    def _fit(
        self, texels: FitSurface, photos: list[Pixels], held: list[Pixels], diffuse_object: bool, diffuse: bool, evidence: str
    ) -> Choice:
        """Run the fit from each initial roughness that trials leave open, and report what was decided."""
        settings, monitor = self.options.bake, self.monitor
        priors = Priors(settings.smoothness, settings.base_color_l1, settings.metallic_l1, settings.neutral_light, settings.sparsity)

        def each(done: int, total: int) -> None:
            monitor.check_stop()
            monitor.progress(done, total, "material fit")

        def start(roughness: float) -> MaterialFit:
            return MaterialFit(texels, self.options.light_size, priors, roughness)

        trials = {} if diffuse_object else trial_roughness(start, photos, self.seed, lambda done, total: monitor.check_stop())
        begun = time.perf_counter()
        choice = best_fit(start, photos, held, settings.fit_iterations, self.seed, trials, diffuse_object, each)
        seconds = (time.perf_counter() - begun) / (settings.fit_iterations * choice.fits)
        fitted = choice.fitted
        monitor.decide("initial roughness", f"{choice.roughness:g}", choice.why)
        if choice.metals:
            kept = "kept" if fitted.metal.any() else "metallic rejected on held-out views"
            monitor.decide("metallic validation", kept, choice.metals)
        saved = trial_cost(photos, seconds)
        skipped, done = "diffuse object", "specular reflection fitted"
        decide_skip(monitor, "specular", self.options.specular, diffuse, evidence, skipped, done, saved)
        monitor.decide("light intensity", ", then ".join(map(str, fitted.levels)), "lowest residual with the best base colours")
        monitor.decide("emission", f"{fitted.glowing} regions", "bright, bounded by an edge, and independent of irradiance")
        return choice

    def _full_texture(self, choice: Choice, photos: list[Pixels], held: list[Pixels], cameras: list[Camera]) -> Floats:
        """The fit's values at all texels (n, 5 or 8), without the maps that are not needed, with fine detail."""
        coarse, fit, fitted, options = self.coarse, choice.fit, choice.fitted, self.options
        fine = coarse.detail(self.projected.values)
        judges = held if any(map(len, held)) else photos
        metals = int(fitted.metal.sum())
        rules = {"metallic_map": options.metallic_map, "roughness_map": options.roughness_map}

        def decide(name: str, holds: bool, evidence: str, skipped: str, done: str) -> bool:
            return decide_skip(self.monitor, name, rules[name], holds, evidence, skipped, done)

        plain = plainer(fitted.values, fitted.weight, metals, partial(fit.psnr, judges), decide)
        values = coarse.up(plain)
        values[:, :3] *= fine
        if metals and plain[:, 4].any():
            shot = list(zip(photos, cameras, strict=True))
            values = sharp_metals(self.surface, coarse, fit, fitted.metal, plain[:, 3], values, shot)
        if fitted.glowing:
            values = np.concatenate([values, coarse.up(fitted.glow) * fine], 1)
        return values

    def _result(self, choice: Choice, values: Floats, footprint: float, photos: list[Pixels]) -> FittedTextures:
        """Textures, refined normals, light and figures."""
        coarse, fitted = self.coarse, choice.fitted
        known = coarse.up(fitted.weight[:, None])[:, 0] > MIN_OBSERVATIONS * (coarse.edge / footprint) ** 2
        normal = self.detail.normal + np.where(known[:, None], coarse.up(fitted.bend), 0)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        figures: dict[str, Any] = {
            "fit_psnr": fitted.held_out,
            "fit_pixels": sum(map(len, photos)),
            "fit_texels": len(coarse.texels),
            "fit_metal_texels": int(fitted.metal.sum()),
            "fit_glowing_regions": fitted.glowing,
        }
        textures = replace(self.projected, values=values, views=np.where(known, self.projected.views, 0))
        return FittedTextures(textures, replace(self.detail, normal=normal), fitted.light, figures)
