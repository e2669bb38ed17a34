"""Ray-traced reflections of the object on itself: one reflected ray per pixel, traced once, as mesh and cameras do not change.

A smooth lobe reflects the environment where the ray is unoccluded, else the texel that it hits. How far a rough lobe follows that ray is
decided in shading (`gsbake.shading.reflection_kernel.specular_visibility`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import RayCaster
from gsbake.materials.pixels import Pixels
from gsbake.shading.reflections import trace_reflections
from gsbake.texturing.texels import Texels


@dataclass(frozen=True)
class ReflectionTracer:
    """Traces reflected rays on the mesh in `caster`, whose faces the `texels` refer to, with `uv` (v, 2), origin top left.

    `position` (n, 3) and shading `normal` (n, 3) of the texels; rays start `offset` above the surface (mesh units).
    """

    caster: RayCaster
    uv: NDArray[Any]
    texels: Texels
    position: NDArray[Any]
    normal: NDArray[Any]
    offset: float

    def trace(self, pixels: Pixels) -> Pixels:
        """The pixels with the texel that each reflected ray hits."""
        position, shading = (np.einsum("nk,nkd->nd", pixels.bilinear, x[pixels.texel]) for x in (self.position, self.normal))
        dominant = pixels.texel[np.arange(len(pixels)), pixels.bilinear.argmax(1)]
        sent, hits = trace_reflections(self.caster, self.texels.face[dominant], position, shading, pixels.view, self.offset)
        uv = np.einsum("nk,nkd->nd", hits.bary[hits.hit], self.uv[self.caster.faces[hits.face[hits.hit]]])
        reflected = np.full(len(pixels), -1, np.int64)
        reflected[sent[hits.hit]] = self.texels.containing(uv)
        return replace(pixels, reflected_texel=reflected)
