"""A base colour finer than the other maps: the photos, projected at their full size, refine the colour that the coarser texture has.

The result is the coarse colour, interpolated, times the ratio of the projected colours to their own coarse version: light and materials
are those of the coarse texture, the detail is that of the photos. The fine texture is projected in bands of rows, so that memory does not
grow with its size.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.monitor import Monitor
from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.photo_projection import PhotoReader
from gsbake.texturing.projection import ProjectionBlender
from gsbake.texturing.resampling import DETAIL_OFFSET
from gsbake.texturing.texels import rasterise
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Floats = NDArray[np.float32]
Halves = NDArray[np.float16]
Flags = NDArray[np.bool_]

#: Texels of the surface that are projected at once; each takes 170 bytes.
BAND_TEXELS = 6_000_000
#: Detail is a ratio within this factor of 1.
MAX_RATIO = 8.0


def fine_base_color(
    surface: UnwrappedMesh, photos: FullPhotos, coarse: Floats, size: int, gains: Floats, holdout: int, monitor: Monitor
) -> Floats:
    """Linear base colour (size, size, 3) with the detail of the photos, whose exposure `gains` (views, 3) are divided out.

    `coarse` (s, s, 3) is the finished one of the texture of `surface`, without empty texels; `size` is s times a power of two.
    """
    projected, observed = _project(surface, photos, size, gains, holdout, monitor)
    out = np.empty((size, size, 3), np.float32)
    for channel in range(3):
        monitor.check_stop()
        out[..., channel] = _refined(np.ascontiguousarray(coarse[..., channel]), projected[..., channel], observed)
    return out


def _project(surface: UnwrappedMesh, photos: FullPhotos, size: int, gains: Floats, holdout: int, monitor: Monitor) -> tuple[Halves, Flags]:
    """Linear colours of the photos on a texture of `size`, and where there are some."""
    reader, atlas = PhotoReader(photos, holdout), surface.atlas
    edge = surface.texel_size * surface.texels.size / size
    colour, observed = np.zeros((size * size, 3), np.float16), np.zeros(size * size, np.bool_)
    bands = max(1, -(-len(surface.texels) * size**2 // surface.texels.size**2 // BAND_TEXELS))
    rows = np.linspace(0, size, bands + 1).round().astype(int)
    for band in range(bands):
        texels = rasterise(atlas.uv, atlas.faces, size, (int(rows[band]), int(rows[band + 1])))
        if not len(texels):
            continue
        normal = texels.interpolate(surface.normal, atlas.faces)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        position = texels.interpolate(surface.position, atlas.faces)
        blender = ProjectionBlender(position, normal, surface.caster, 3, edge, whole=surface.texel_position)
        for index in range(len(photos)):
            monitor.check_stop()
            reader.add(blender, index)
            monitor.progress(band * len(photos) + index + 1, bands * len(photos), "base colour")
        fused = blender.result(known_gains=gains)
        colour[texels.index], observed[texels.index] = fused.values, fused.observed
    return colour.reshape(size, size, 3), observed.reshape(size, size)


def _refined(coarse: Floats, projected: Halves, observed: Flags) -> Floats:
    """One channel: `coarse` (s, s) with the detail of the `projected` colours (n, n) where they are `observed` (n, n)."""
    small, large = coarse.shape, projected.shape
    known = observed.astype(np.float32)
    share = cv2.resize(known, small, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(projected.astype(np.float32) * known, small, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    filled = fill_empty_texels(mean[..., None], share > 0, gutter=4)[..., 0]
    smooth = cv2.resize(filled, large, interpolation=cv2.INTER_LINEAR)
    ratio = (projected.astype(np.float32) + DETAIL_OFFSET) / (smooth + DETAIL_OFFSET)
    ratio[~observed] = 1
    refined = cv2.resize(coarse, large, interpolation=cv2.INTER_LINEAR) * np.clip(ratio, 1 / MAX_RATIO, MAX_RATIO)
    return np.asarray(np.clip(refined, 0, 1), np.float32)
