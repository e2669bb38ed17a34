"""The ambient occlusion map: traced on the dense mesh, at reduced resolution for large textures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import RayCaster
from gsbake.texturing.ambient_occlusion import occlusion, smooth_over_surface
from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.normal_map import DenseSamples, sample_dense_mesh
from gsbake.texturing.texels import rasterise
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Floats = NDArray[np.float32]

#: Largest edge in texels at which occlusion is traced; larger maps are upsampled, as occlusion is smooth.
MAX_SIZE = 1024


def bake_occlusion(
    surface: UnwrappedMesh,
    dense: tuple[RayCaster, NDArray[Any]],
    detail: DenseSamples,
    rays: int,
    offset: float,
    radius: float,
    each: Callable[[int, int], None] | None = None,
) -> Floats:
    """Ambient occlusion (n,) of the surface's n texels, 1 = open.

    `dense` is the dense mesh with its vertex normals, `detail` its points at the texels; where there is none the low-poly mesh is traced.
    `rays` per texel start `offset` above the surface (mesh units); texels within `radius` texels are averaged; `each(done, total)` is
    called after every round of one ray per texel.
    """
    texels, size = surface.texels, surface.texels.size
    if size > MAX_SIZE:
        texels = rasterise(surface.atlas.uv, surface.atlas.faces, MAX_SIZE)
        normal = texels.interpolate(surface.normal, surface.atlas.faces)
        detail = sample_dense_mesh(texels.interpolate(surface.position, surface.atlas.faces), normal, *dense, surface.diagonal)
    value = np.ones(len(texels), np.float32)
    for mine, caster in ((detail.found, dense[0]), (~detail.found, surface.caster)):
        if mine.any():
            value[mine] = occlusion(detail.position[mine], detail.normal[mine], caster, rays, offset, each)
    value = smooth_over_surface(texels, value, detail.position, detail.normal, radius * surface.texel_size * size / texels.size)
    if texels is surface.texels:
        return value
    image = fill_empty_texels(texels.image(value), texels.covered(), gutter=2)[..., 0]
    large = cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large.ravel()[surface.texels.index], np.float32)
