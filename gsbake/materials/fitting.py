"""Material textures of an unwrapped mesh: read photos, trace visibility, run the recipe of the fit, and report."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.roles import held_out, test_photos, validation_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.view_dependence import is_diffuse
from gsbake.config.schema import Bake
from gsbake.geometry.cameras import Camera
from gsbake.materials.light_motions import light_motions
from gsbake.materials.passes import Priors, Scene, Target, run_passes
from gsbake.materials.photo import SURFACE_POINTS, MeshBrightness, Photo, PhotoReader, texel_weight
from gsbake.materials.recipe import FIT, MAPS
from gsbake.materials.state import Finer, Level, State
from gsbake.materials.surface import InterpolatedTransport, Materials, Surface, Transport, neighbours
from gsbake.materials.visibility import Visibility
from gsbake.meshing.resolution import pixel_footprint
from gsbake.monitor import Monitor, PartSequence, Rule, decide_skip, skips
from gsbake.texturing.normal_map import DenseSamples
from gsbake.texturing.projection import ProjectedTexture
from gsbake.texturing.resampling import MIN_SIZE, CoarseTexture
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh
from gsbake.texturing.usable_pixels import UsablePixels

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Height of ray origins above the surface, as a share of the diagonal, against self-intersection.
RAY_OFFSET = 0.002
#: Radius of the filter for ray-traced values, in texels.
SMOOTHING_RADIUS = 3.0
#: Largest number of pixels of each photo that materials are fitted to.
MAX_PIXELS = 60_000
#: Least weight of a texel, in frontal views at a texel's size, for its normal to be refined and for it to count as observed.
MIN_OBSERVATIONS = 0.3


@dataclass(frozen=True)
class FitSettings:
    """Settings of the material fit; `light_size` is the edge of the environment map's faces in texels, `holdout` that of training,
    `without` names of passes that are left out, the rest are rules of [skip]."""

    bake: Bake = Bake()
    light_size: int = 32
    holdout: int = 8
    specular: Rule = "auto"
    metallic_map: Rule = "auto"
    roughness_map: Rule = "auto"
    without: frozenset[str] = frozenset()


@dataclass(frozen=True)
class FitResult:
    """The fitted `state` with the maps of the asset, shading `normal` (n, 3) and `observed` texels (n,), and `figures` for the manifest. A
    light that moves is as the first photo saw it."""

    state: State
    maps: Materials
    normal: Doubles
    observed: NDArray[np.bool_]
    figures: dict[str, float | int | None]


@dataclass(frozen=True)
class _Photos:
    """All photos of the capture with their `cameras`; `validation`, those that decisions look at, `test`, those that nothing looks at;
    whether the surface is `diffuse`, and the `evidence`."""

    photos: list[Photo]
    cameras: list[Camera]
    validation: set[int]
    test: set[int]
    diffuse: bool
    evidence: str

    def level(self, surface: Surface) -> Level:
        """The fine level with its `surface`."""
        fitted = [p for p in self.photos if p.index not in self.validation | self.test]
        return Level(surface, fitted, [p for p in self.photos if p.index in self.validation])


def fit_materials(
    surface: UnwrappedMesh,
    posed: PosedPhotos,
    projected: ProjectedTexture,
    detail: DenseSamples,
    occlusion: Floats,
    settings: FitSettings,
    seed: int,
    monitor: Monitor,
) -> FitResult:
    """Base colour, roughness, metallic, emission, normals and light that reproduce the photos.

    `projected` (n, 3) are the photos' colours on the texture: the initial base colour and, where the fit works on a coarser texture, its
    fine detail. `detail` and `occlusion` (n,) are the dense mesh's normals and ambient occlusion at the texels.
    """
    bake = settings.bake
    with PartSequence(monitor) as parts:
        parts.start("light transport")
        cameras = [camera.downscaled_to(bake.fit_size) for camera in posed.cameras.cameras]
        footprint = pixel_footprint(cameras, surface.position.mean(0))
        texture, *coarser = _textures(surface, footprint, monitor)
        reader = PhotoReader(surface.atlas_caster, surface.atlas.uv, texture.texels, texture.down(detail.normal), surface.diagonal)
        read = _read_photos(surface, posed, reader, projected.gains, settings, monitor)
        fine, *surfaces = _surfaces(surface, texture, coarser, reader.normal, occlusion, projected.values, bake, monitor)
        diffuse = skips(settings.specular, read.diffuse)
        if fine.transport is not None and bake.visibility == "reflections" and not diffuse:
            offset = RAY_OFFSET * surface.diagonal
            read = replace(read, photos=[reader.with_reflections(photo, fine.position, offset) for photo in read.photos])

        def progress(name: str, done: int, total: int) -> None:
            monitor.check_stop()
            parts.start(name)
            monitor.progress(done, total, name)

        def skip(name: str, holds: bool, evidence: str, skipped: str, done: str) -> bool:
            rule: Rule = settings.metallic_map if name == "metallic_map" else settings.roughness_map
            return decide_skip(monitor, name, rule, holds, evidence, skipped, done)

        level, kept_out = read.level(fine), settings.holdout
        for at, reduced in zip(surfaces, coarser, strict=True):
            level, kept_out = _coarser_level(level, at, reduced, kept_out), 0
        motion, motions = light_motions(cameras, bake.light_motion, monitor)
        scene = Scene(
            Priors.of(bake), bake.fit_iterations, settings.light_size, seed, diffuse, settings.without, progress,
            motions=motions, flash=all(camera.flash for camera in cameras), decide=monitor.decide,
            target=Target(surface, texture, projected.values, read.cameras, skip),
        )  # fmt: skip
        started = time.perf_counter()
        first = State.start(level.under(motion.rotations), settings.light_size, 0.5)
        state = run_passes(FIT, scene, replace(first, light_motion=motion))
        _report(state, read, settings.specular, monitor, 0.0 if diffuse else time.perf_counter() - started)
        parts.start("full texture")
        state = run_passes(MAPS, scene, state)
        return _result(state, texture, footprint, read, detail)


def _textures(surface: UnwrappedMesh, footprint: float, monitor: Monitor) -> list[CoarseTexture]:
    """The texture of the fit, whose texels are about a pixel of the photos wide (`footprint`, in mesh units), and those of half its edge
    and a quarter."""
    texture = CoarseTexture.of(surface.atlas.uv, surface.atlas.faces, surface.texels, surface.texel_size, footprint)
    size = texture.texels.size
    found = [texture]
    for part in (2, 4):
        last = found[-1]
        found.append(CoarseTexture.sized(surface.atlas.uv, surface.atlas.faces, last.texels, last.edge, max(MIN_SIZE, size // part)))
    monitor.decide("fit texture", f"{size}² texels", f"texel width {texture.edge / footprint:.2f} pixels")
    return found


def _read_photos(
    surface: UnwrappedMesh, posed: PosedPhotos, reader: PhotoReader, gains: Floats, settings: FitSettings, monitor: Monitor
) -> _Photos:
    """Read all photos, exposure gains divided out, and measure view dependence."""
    count, usable = len(posed), UsablePixels(posed)
    points = slice(None, None, max(1, len(surface.texel_position) // SURFACE_POINTS))
    brightness = MeshBrightness(surface.texel_position[points], surface.texel_normal[points], surface.caster, surface.diagonal)
    photos: list[Photo] = []
    cameras: list[Camera] = []
    for index in range(count):
        monitor.check_stop()
        view = posed.view(index, settings.bake.fit_size)
        brightness.add(view)
        photo = reader.read(view.camera, view.rgb, usable.mask(index, view), MAX_PIXELS, index)
        photos.append(photo.without_gain(gains[index], gains.min(0)))
        cameras.append(view.camera)
    validation, test = (set(roles(count, settings.holdout)) for roles in (validation_photos, test_photos))
    return _Photos(photos, cameras, validation, test, *is_diffuse(*brightness.statistics()))


def _surfaces(
    surface: UnwrappedMesh,
    texture: CoarseTexture,
    coarser: list[CoarseTexture],
    normal: Floats,
    occlusion: Floats,
    projected: Floats,
    bake: Bake,
    monitor: Monitor,
) -> list[Surface]:
    """The texels of the fine level and of the `coarser` ones: geometry, ambient occlusion, light transport and initial base colour."""
    ambient, base = texture.down(occlusion[:, None]), texture.down(projected)
    position = texture.texels.interpolate(surface.position, surface.atlas.faces)
    if bake.visibility == "none":
        ambient = np.ones_like(ambient)
    pairs, indirect = neighbours(texture.texels, position, normal), bake.visibility in ("bounce", "reflections")
    fine = Surface(texture.texels, position, pairs, normal, ambient[:, 0], base, None, indirect)
    found = [fine]
    for reduced in coarser:
        found.append(found[-1].coarse(reduced))
    if bake.visibility == "none" or not bake.occlusion_rays:
        return found
    rays, offset = 2 * bake.occlusion_rays, RAY_OFFSET * surface.diagonal  # over the whole sphere
    traced = [
        Visibility.trace(
            one.texels, surface.atlas.uv, surface.atlas_caster, one.normal, rays, offset, SMOOTHING_RADIUS * reduced.edge,
            lambda *_: monitor.check_stop(),
        )
        for one, reduced in zip(found[1:], coarser, strict=True)
    ]  # fmt: skip
    transports: list[Transport] = [InterpolatedTransport(traced[0], coarser[0]), *traced]
    return [replace(one, transport=transport) for one, transport in zip(found, transports, strict=True)]


def _coarser_level(fine: Level, surface: Surface, texture: CoarseTexture, holdout: int) -> Level:
    """The next coarser level. Few photos are held out, so it adds every `holdout`-th of those to fit to the validation photos, 0: none; the
    fine level fits them."""
    photos, validation = ([p.on_coarse_texels(texture, surface.normal) for p in role] for role in (fine.photos, fine.validation))
    added = set(held_out(len(photos), holdout)) if validation and holdout else set()
    kept = [p for i, p in enumerate(photos) if i not in added]
    return Level(surface, kept, validation + [photos[i] for i in sorted(added)], Finer(fine, texture))


def _report(state: State, read: _Photos, specular: Rule, monitor: Monitor, saved: float) -> None:
    """Report the decisions of the fit; skipping specular reflection would have `saved` so many seconds."""
    metallic, roughness = state.chosen_start
    monitor.decide("initial material", f"metallic {metallic:g}, roughness {roughness:g}", state.evidence)
    skipped, done = "diffuse object", "specular reflection fitted"
    decide_skip(monitor, "specular", specular, read.diffuse, read.evidence, skipped, done, saved)
    certain = "lowest residual with the best base colours"
    if state.open_factors is not None:
        low, high = state.open_factors
        certain += f"; factors of {low:.2f} to {high:.2f} are open, and one over them on base colours"
    monitor.decide("light intensity", "; ".join(map(str, state.adjustments)), certain)
    monitor.decide("emission", f"{state.emissive_regions} regions", "bright, bounded by an edge, and independent of irradiance")


def _result(state: State, texture: CoarseTexture, footprint: float, read: _Photos, detail: DenseSamples) -> FitResult:
    """Maps, refined normals and figures; `fit_psnr` is that on test photos."""
    assert state.maps is not None and state.maps.normal_offset is not None
    photos = [photo for photo in state.level.photos if len(photo)]
    weight = texture.up(texel_weight(photos, len(state.values))[:, None])[:, 0]
    observed = weight > MIN_OBSERVATIONS * (texture.edge / footprint) ** 2
    normal = detail.normal + np.where(observed[:, None], state.maps.normal_offset, 0)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rotations = state.light_motion.rotations
    test = [p if rotations is None else replace(p, to_light=rotations[p.index]) for p in read.photos if p.index in read.test]
    figures: dict[str, float | int | None] = {
        "fit_psnr": state.decibels(test),
        "fit_pixels": sum(map(len, state.level.photos)),
        "fit_texels": len(texture.texels),
        "fit_metal_texels": int(state.metal.sum()),
        "fit_emissive_regions": state.emissive_regions,
        "light_factor_low": state.open_factors and state.open_factors[0],
        "light_factor_high": state.open_factors and state.open_factors[1],
    }
    return FitResult(state, state.maps, normal, observed, figures)
