"""Intensity and colour of the light from patches of known reflectance.

Brighter light on darker base colour looks the same, so photos alone hardly tell either; a patch whose reflectance is known does. Base
colour is multiplied so that it is right there, in each channel, and the light is divided by the same: diffuse colours and the reflections
of metals stay as they were fitted. Dielectrics reflect 4 % whatever their colour; those reflections change with the light.
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
from gsbake.materials.printed_light import MAX_VALUE
from gsbake.monitor import Monitor
from gsbake.scale.printed_white import PrintedPatches, find_printed
from gsbake.scale.triangulation import PickedPhotos, find_entry
from gsbake.shading.environment import EnvironmentLight
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

#: A patch is a square of this share of the photo's longer side, sampled by so many rays along each side.
PATCH_SIZE, PATCH_RAYS = 0.01, 9
#: Base colour below this cannot be that of a patch of known reflectance: it would multiply noise.
MIN_BASE_COLOR = 0.01
#: Share of the texels whose base colour may exceed 1, and ratio of two patches, from which on a warning is given.
MAX_CLIPPED, MAX_RATIO = 0.01, 1.15


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
