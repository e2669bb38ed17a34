"""Intensity and colour of the light from patches of known reflectance.

Brighter light on darker base colour looks the same, so photos alone hardly tell either; a patch whose reflectance is known does. Base
colour is multiplied so that it is right there, in each channel, and the light is divided by the same: diffuse colours and the reflections
of metals stay as they were fitted. Dielectrics reflect 4 % whatever their colour; those reflections change with the light.

Markers and colour cards beside the object say the same: paper of the reflectance R under the irradiance E sends R E / π. The fitted light
says E at the paper, less what the mesh hides; photos show what the paper sends. A fitted light that is too bright, on base colours that are
too dark, is so by the ratio of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.white import PrintedWhite, WhitePatch, parse_white
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode_bytes
from gsbake.monitor import Monitor
from gsbake.scale.printed_white import PrintedPatches, find_printed
from gsbake.scale.triangulation import PickedPhotos, find_entry
from gsbake.shading import cubemap
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import LightMotion
from gsbake.texturing.projection import ProjectedTexture
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

#: A patch is a square of this share of the photo's longer side, sampled by so many rays along each side.
PATCH_SIZE, PATCH_RAYS = 0.01, 9
#: Base colour below this cannot be that of a patch of known reflectance: it would multiply noise.
MIN_BASE_COLOR = 0.01
#: Share of the texels whose base colour may exceed 1, and ratio of two patches, from which on a warning is given.
MAX_CLIPPED, MAX_RATIO = 0.01, 1.15
#: Rays over the hemisphere of each point, and their height above the paper, as a share of the object's diagonal.
RAYS, LIFT = 1024, 0.002
#: Least cosine of the view and least size in pixels of a patch, and the brightest 8-bit value that is not clipped.
MIN_COSINE, MIN_PIXELS, MAX_VALUE = 0.3, 4.0, 250
#: Least radiance of a patch that tells of the light.
MIN_RADIANCE = 0.005


@dataclass(frozen=True)
class WhiteTexels:
    """A patch and the texels (m,) that it shows; `clipped`: its photo is overexposed there."""

    patch: WhitePatch
    texel: NDArray[np.int64]
    clipped: bool = False


@dataclass(frozen=True)
class KnownWhite:
    """What has a known reflectance: patches on the object and, beside it, printed markers and cards."""

    on_object: list[WhiteTexels]
    printed: list[PrintedPatches]

    def __bool__(self) -> bool:
        return bool(self.on_object or self.printed)


@dataclass(frozen=True)
class Evidence:
    """The factor (3,) on base colour that one patch asks for, None where it cannot be used; what it is called, and what it showed."""

    name: str
    factor: Doubles | None
    shown: str = ""


def find_white(texts: Sequence[str], ingest: Path, posed: PosedPhotos, surface: UnwrappedMesh) -> KnownWhite:
    """What `texts` name (`bake.white`), in the photos of the artifact folder `ingest` and in `posed`, which has the frame of the `surface`.
    Raises BadInputError for a patch that is in no photo or not on the surface, and for markers or a card that no photo shows."""
    wanted = [parse_white(text) for text in texts]
    patches = [patch for patch in wanted if isinstance(patch, WhitePatch)]
    printed = [white for white in wanted if isinstance(white, PrintedWhite)]
    cameras, photos = posed.cameras.cameras, posed.folder / "photos"
    return KnownWhite(
        _texels(patches, ingest, posed, surface) if patches else [],
        [patch for white in printed for patch in find_printed(white, cameras, photos)],
    )


def _texels(patches: Sequence[WhitePatch], ingest: Path, posed: PosedPhotos, surface: UnwrappedMesh) -> list[WhiteTexels]:
    """The texels of each patch."""
    photos, to_world = PickedPhotos.open(ingest, posed.folder, "a white patch"), posed.cameras.to_world
    side = PATCH_SIZE * np.linspace(-0.5, 0.5, PATCH_RAYS)
    offsets = np.concatenate([np.zeros((1, 2)), np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)])
    found = []
    for patch in patches:
        rays = photos.rays(patch.position, offsets)
        origin = to_world.inverse().apply(rays[0].origin)[None]
        hits = surface.atlas_caster.first_hit(origin, np.stack([ray.direction for ray in rays]) @ to_world.rotation)
        if not hits.hit[0]:
            raise BadInputError(f"bake: the white patch '{patch.text}' is not on the object; name a pixel where the photo shows it.")
        corners = surface.atlas.uv[surface.atlas.faces[hits.face[hits.hit]]]
        texel = surface.texels.containing(np.einsum("nk,nkd->nd", hits.bary[hits.hit], corners))
        texel = np.unique(texel[texel >= 0])
        name = find_entry(photos.entries, patch.position.photo, "A white patch")["name"]
        found.append(WhiteTexels(patch, texel, _clipped(posed, name, surface.texel_position[texel].astype(np.float64))))
    return found


def _clipped(posed: PosedPhotos, name: str, points: Doubles) -> bool:
    """Whether most of the `points` (m, 3) are overexposed in the photo `name`."""
    view = posed.view(next(index for index, camera in enumerate(posed.cameras.cameras) if camera.name == name))
    pixel, depth = view.camera.project(points)
    column, row = np.floor(pixel[view.camera.in_view(pixel, depth)]).astype(np.int64).T
    return bool(len(row)) and float((view.rgb[row, column] > MAX_VALUE).any(1).mean()) > 0.5


def on_object(values: Floats, observed: NDArray[np.bool_], patches: Sequence[WhiteTexels]) -> list[Evidence]:
    """What the `patches` ask for, by the fitted `values` (n, 3, 5 or 8) of their `observed` texels (n,): linear base colour, then roughness
    and metallic, then emission. Texels that emit light do not count."""
    emits = np.asarray((values[:, 5:] > MIN_BASE_COLOR).any(1))
    found = []
    for white in patches:
        texel, known = white.texel[observed[white.texel] & ~emits[white.texel]], white.patch.reflectance
        colour = np.median(values[texel, :3], axis=0).astype(np.float64) if len(texel) else np.zeros(3)
        factor = known / colour if colour.min() >= MIN_BASE_COLOR and not white.clipped else None
        found.append(Evidence(f"patch '{white.patch.text}'", factor, f"{_three(colour)} where {known:g} is known"))
    return found


def printed_factors(
    patches: Sequence[PrintedPatches],
    posed: PosedPhotos,
    gains: NDArray[np.floating],
    caster: RayCaster,
    radiance: NDArray[np.float32],
    rotations: Doubles | None,
) -> list[Doubles | None]:
    """The factor (3,) on base colour that each of the `patches` in the frame of `posed` asks for, the median over points and photos; None
    where no photo shows it unclipped and at a sufficient size.

    `gains` (photos, 3) of the exposures; `caster` holds the object, `radiance` (6, s, s, 3) is the fitted light, which `rotations`
    (photos, 3, 3) turn to the frame of a light that moves.
    """
    found: list[list[Doubles]] = [[] for _ in patches]
    lift = LIFT * float(np.linalg.norm(np.ptp(caster.vertices, axis=0)))
    origins = [patch.points + lift * patch.normal for patch in patches]
    rays = [_hemisphere(patch.normal) for patch in patches]
    free = [np.stack([~caster.occluded(point[None], around) for point in points]) for points, around in zip(origins, rays, strict=True)]
    for index, camera in enumerate(posed.cameras.cameras):
        rgb = posed.view(index).rgb
        for k, patch in enumerate(patches):
            pixel, depth = camera.project(patch.points)
            view = camera.centre - patch.points
            distance = np.linalg.norm(view, axis=1)
            large = camera.fx * patch.spacing * (view @ patch.normal / distance) / distance > MIN_PIXELS
            usable = camera.in_view(pixel, depth) & large & (view @ patch.normal > MIN_COSINE * distance)
            usable[usable] = ~caster.occluded(origins[k][usable], view[usable], 1.0)
            column, row = np.floor(pixel[usable]).astype(np.int64).T
            shown = rgb[row, column]
            clear = (shown <= MAX_VALUE).all(1)
            seen = decode_bytes(shown[clear]) / np.asarray(gains[index], np.float64)
            bright = (seen > MIN_RADIANCE).all(1)
            chosen = np.flatnonzero(usable)[clear][bright]
            if not len(chosen):
                continue
            turned = rays[k] if rotations is None else rays[k] @ rotations[index].T
            arriving = free[k][chosen].astype(np.float64) @ cubemap.sample(radiance, turned) / RAYS
            found[k].extend(patch.reflectance[chosen, None] * arriving / seen[bright])
    return [_factor(factors) for factors in found]


def _factor(factors: list[Doubles]) -> Doubles | None:
    """The median of the factors (3,); None without any, or where the fitted light is black."""
    factor = np.median(factors, axis=0) if factors else np.zeros(3)
    return factor if (factor > 0).all() else None


def _hemisphere(normal: Array) -> Array:
    """Directions (RAYS, 3) about a unit `normal` (3,), as dense as the cosine: the mean of what comes along them is the irradiance / π."""
    k = np.arange(RAYS) + 0.5
    radius, angle = np.sqrt(k / RAYS), np.pi * (3 - 5**0.5) * k
    across = np.linalg.svd(normal[None])[2][1:]
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1) @ across
    return np.asarray(flat + np.sqrt(1 - radius**2)[:, None] * normal)


def white_factor(
    white: KnownWhite, projected: ProjectedTexture, posed: PosedPhotos, caster: RayCaster, light: Path, monitor: Monitor
) -> Doubles:
    """The factor (3,) on base colour that all of `white` asks for, by the `projected` maps with fitted materials and by the fitted light in
    the file `light`, beside which `light_motion.json` says how it moves. `caster` holds the object in the frame of `posed`."""
    found = on_object(projected.values, projected.observed, white.on_object)
    if white.printed:
        rotations = LightMotion.load(light.with_name("light_motion.json")).rotations
        radiance = EnvironmentLight.load(light).radiance().detach().numpy()
        factors = printed_factors(white.printed, posed, projected.gains[:, :3], caster, radiance, rotations)
        found += [Evidence(patch.name, factor) for patch, factor in zip(white.printed, factors, strict=True)]
    return common_factor(found, monitor)


def common_factor(found: Sequence[Evidence], monitor: Monitor) -> Doubles:
    """The factor (3,) on base colour, the geometric mean of all; one where nothing can be used. Warns of that and of contradictions."""
    for one in found:
        if one.factor is None:
            monitor.warn(f"bake: the white {one.name} is black, clipped, taken for a lamp or hardly seen, and is not used.")
    used = [one for one in found if one.factor is not None]
    factors = [one.factor for one in used if one.factor is not None]
    if not factors:
        return np.ones(3)
    factor = np.exp(np.log(factors).mean(0))
    ratio = float((np.max(factors, axis=0) / np.min(factors, axis=0)).max())
    if ratio > MAX_RATIO:
        monitor.warn(f"bake: known whites contradict each other by a factor of {ratio:.2f}; check their places and reflectances.")
    monitor.decide("white", f"base colour × {_three(factor)}", "; ".join(f"{one.name}: {one.shown or _three(factor)}" for one in used))
    return np.asarray(factor, np.float64)


def _three(values: Doubles) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def with_factor(base_color: Floats, factor: Doubles, monitor: Monitor) -> Floats:
    """The `base_color` (n, 3) times `factor` (3,), at most 1; warns where much of it would exceed that."""
    scaled = base_color * factor.astype(np.float32)
    clipped = float((scaled > 1).any(1).mean())
    if clipped > MAX_CLIPPED:
        monitor.warn(f"bake: by the white patches {clipped:.0%} of the base colour would exceed 1; the patches may be darker than given.")
    return np.minimum(scaled, 1)


def divide_light(path: Path, factor: Doubles) -> None:
    """Divide the radiance of the light in the file `path` by `factor` (3,)."""
    radiance = EnvironmentLight.load(path).radiance().detach().numpy()
    EnvironmentLight.from_radiance(radiance / factor.astype(np.float32)).save(path)
