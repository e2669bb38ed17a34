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

from gsbake.config.white import WhitePatch
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Similarity
from gsbake.monitor import Monitor
from gsbake.scale.triangulation import PickedPhotos
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
    """A patch and the texels (m,) that it shows."""

    patch: WhitePatch
    texel: NDArray[np.int64]


def find_white(patches: Sequence[WhitePatch], ingest: Path, poses: Path, to_world: Similarity, surface: UnwrappedMesh) -> list[WhiteTexels]:
    """The texels of `patches`, seen in the photos of the artifact folders `ingest` and `poses`; `to_world` maps the frame of the `surface`
    to that of the cameras. Raises BadInputError for a patch that is in no photo, or not on the surface."""
    if not patches:
        return []
    photos = PickedPhotos.open(ingest, poses, "a white patch")
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
        found.append(WhiteTexels(patch, np.unique(texel[texel >= 0])))
    return found


def white_factor(base_color: Floats, observed: NDArray[np.bool_], patches: Sequence[WhiteTexels], monitor: Monitor) -> Doubles:
    """The factor (3,) on the linear `base_color` (n, 3) that the `patches` ask for, the geometric mean over them; only `observed` texels
    (n,) count. One where no patch can be used, which is warned of, as is a contradiction between them."""
    factors, evidence = [], []
    for white in patches:
        texel = white.texel[observed[white.texel]]
        colour = np.median(base_color[texel], axis=0).astype(np.float64) if len(texel) else np.zeros(3)
        if colour.min() < MIN_BASE_COLOR:
            monitor.warn(f"bake: the white patch '{white.patch.text}' is black or unseen in the base colour, and is not used.")
            continue
        factors.append(white.patch.reflectance / colour)
        shown = " ".join(f"{value:.3f}" for value in colour)
        evidence.append(f"{white.patch.text}: {shown} where {white.patch.reflectance:g} is known")
    if not factors:
        return np.ones(3)
    factor = np.exp(np.log(factors).mean(0))
    ratio = float((np.max(factors, axis=0) / np.min(factors, axis=0)).max())
    if ratio > MAX_RATIO:
        monitor.warn(f"bake: the white patches contradict each other by a factor of {ratio:.2f}; check their places and reflectances.")
    monitor.decide("white", "base colour × " + " ".join(f"{value:.2f}" for value in factor), "; ".join(evidence))
    return np.asarray(factor, np.float64)


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
