"""Intensity and colour of the light from printed markers and colour cards beside the object.

Paper of the reflectance R under the irradiance E sends R E / π. The fitted light says E at the paper, less what the mesh hides; photos show
what the paper sends. A fitted light that is too bright, on base colours that are too dark, is so by the ratio of the two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Array
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode_bytes
from gsbake.scale.printed_white import PrintedPatches
from gsbake.shading import cubemap

Doubles = NDArray[np.float64]

#: Rays over the hemisphere of each point, and their height above the paper, as a share of the object's diagonal.
RAYS, LIFT = 1024, 0.002
#: Least cosine of the view and least size in pixels of a patch, and the brightest 8-bit value that is not clipped.
MIN_COSINE, MIN_PIXELS, MAX_VALUE = 0.3, 4.0, 250
#: Least radiance of a patch that tells of the light.
MIN_RADIANCE = 0.005


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
