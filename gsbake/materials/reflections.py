"""What of the object itself a mirror would show in each pixel: the view is turned at the shading normal by the law of reflection.

One ray a pixel, traced once, as mesh and cameras stay. A smooth lobe then reflects the room where that ray is open and the texel it
meets where it is not; how far a rough one goes by it is for the shading to say (`gsbake.shading.split_sum.traced_openness`).

Whitted, *An improved illumination model for shaded display*, CACM 1980 (the reflected ray).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import RayCaster
from gsbake.materials.pixels import Pixels
from gsbake.texturing.texels import Texels


@dataclass(frozen=True)
class Mirrors:
    """A mesh whose faces the `texels` name, in the `caster`, with texture coordinates `uv` (v, 2), origin top left. Texels lie `at` (n, 3)
    with shading normals `normal` (n, 3); rays start `above` the surface (mesh units)."""

    caster: RayCaster
    uv: NDArray[Any]
    texels: Texels
    at: NDArray[Any]
    normal: NDArray[Any]
    above: float

    def traced(self, pixels: Pixels) -> Pixels:
        """The pixels with the texel that each mirrored view meets."""
        place, shading = (np.einsum("nk,nkd->nd", pixels.share, x[pixels.texel]) for x in (self.at, self.normal))
        shading /= np.maximum(np.linalg.norm(shading, axis=1, keepdims=True), 1e-20)
        foremost = pixels.texel[np.arange(len(pixels)), pixels.share.argmax(1)]
        corner = self.caster.vertices[self.caster.faces[self.texels.face[foremost]]]
        facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-20)
        ray = 2 * np.einsum("nk,nk->n", shading, pixels.towards)[:, None] * shading - pixels.towards
        up = np.flatnonzero(np.einsum("nk,nk->n", facing, ray) > 0)  # below the mesh's own horizon it would start inside
        hits = self.caster.first_hit(place[up] + self.above * facing[up], ray[up])
        there = np.einsum("nk,nkd->nd", hits.bary[hits.hit], self.uv[self.caster.faces[hits.face[hits.hit]]])
        met = np.full(len(pixels), -1, np.int64)
        met[up[hits.hit]] = self.texels.holding(there)
        return replace(pixels, met=met)
