"""Ambient occlusion of a whole texture: traced where the dense surface is, on a smaller texture where that is enough."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import RayCaster
from gsbake.texturing.ambient_occlusion import occlusion, smoothed
from gsbake.texturing.inpainting import flood
from gsbake.texturing.normal_map import Detail, find_detail
from gsbake.texturing.texels import rasterise
from gsbake.texturing.unwrapped_mesh import Surface

Floats = NDArray[np.float32]

#: Occlusion is smooth: it is traced on at most this many texels along the edge and enlarged.
LARGEST = 1024


def open_share(
    surface: Surface,
    dense: tuple[RayCaster, NDArray[Any]],
    detail: Detail,
    rays: int,
    above: float,
    reach: float,
    each: Callable[[int, int], None] | None = None,
) -> Floats:
    """Open share (n,) in 0..1 of the hemisphere over each of the surface's n texels.

    `dense` is the dense surface with its vertex normals, `detail` what of it each texel shows; where that is nothing the light mesh is
    traced. `rays` start `above` the surface (mesh units); neighbours within `reach` texels are averaged; `each(done, total)` tells how far
    it is.
    """
    texels, size = surface.texels, surface.texels.size
    if size > LARGEST:
        texels = rasterise(surface.atlas.uv, surface.atlas.faces, LARGEST)
        facing = texels.interpolate(surface.normal, surface.atlas.faces)
        detail = find_detail(texels.interpolate(surface.position, surface.atlas.faces), facing, *dense, surface.diagonal)
    value = np.ones(len(texels), np.float32)
    for mine, caster in ((detail.found, dense[0]), (~detail.found, surface.caster)):
        if mine.any():
            value[mine] = occlusion(detail.position[mine], detail.normal[mine], caster, rays, above, each)
    value = smoothed(texels, value, detail.position, detail.normal, reach * surface.texel * size / texels.size)
    if texels is surface.texels:
        return value
    image = flood(texels.image(value), texels.covered(), rim=2)[..., 0]
    large = cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large.ravel()[surface.texels.index], np.float32)
