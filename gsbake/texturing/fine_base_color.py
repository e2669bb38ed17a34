"""A base colour finer than the other maps: the photos, projected at their full size, refine the colour that the coarser texture has.

The result is the projected colours times the ratio of the coarse colour to their own coarse version, interpolated: light and materials
are those of the coarse texture, the detail is that of the photos, with the energy that averaging took from it (`detail_gain`). The fine
texture is projected in bands of rows, so that memory does not grow with its size.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.imaging.srgb import decode_bytes, encode_bytes
from gsbake.monitor import Monitor
from gsbake.texturing.detail_gain import PATCHES, DetailEnergy, chart_codes, detail_factor
from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.photo_projection import PhotoProjector
from gsbake.texturing.projection import ProjectionBlender
from gsbake.texturing.resampling import DETAIL_OFFSET
from gsbake.texturing.texels import rasterise
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Floats = NDArray[np.float32]
Halves = NDArray[np.float16]
Flags = NDArray[np.bool_]
Bytes = NDArray[np.uint8]

#: Texels of the surface that are projected at once; bytes of each, and of one of the texture that holds the result.
BAND_TEXELS, BAND_BYTES, RESULT_BYTES = 6_000_000, 170, 26
#: Light and materials change the photos' colours by a factor of at most so much; where it is smooth, it is averaged over so many coarse
#: texels: the coarse texture is less sharp than the mean of the fine one, and would blur it.
MAX_RATIO, SMOOTH_TEXELS = 8.0, 2.0


def fine_base_color(
    surface: UnwrappedMesh,
    photos: FullPhotos,
    coarse: Floats,
    size: int,
    gains: Floats,
    holdout: int,
    smooth: bool,
    monitor: Monitor,
) -> Floats:
    """Linear base colour (size, size, 3) with the detail of the photos, whose exposure `gains` (views, 3) are divided out.

    Of the values that 8-bit sRGB has, which is what assets hold: with more digits the file would be twice to three times as large.

    `coarse` (s, s, 3) is the finished one of the texture of `surface`, without empty texels; `size` is s times a power of two. `smooth`: it
    differs from the photos' colours by what varies slowly, as shading does, and not from texel to texel, as materials may.
    """
    projected, observed, charts, energy = _project(surface, photos, size, gains, holdout, monitor)
    monitor.decide("detail", ", ".join(f"{gain:.2f}x" for gain in energy.gains), energy.evidence)
    sharpened = detail_factor(projected, observed, energy.gains, charts)
    out = np.empty((size, size, 3), np.float32)
    for channel in range(3):
        monitor.check_stop()
        colour = projected[..., channel].astype(np.float32) * sharpened
        refined = _refined(np.ascontiguousarray(coarse[..., channel]), colour, observed, smooth)
        out[..., channel] = decode_bytes(encode_bytes(refined))
    return out


def needed_bytes(surface: UnwrappedMesh, size: int) -> int:
    """Memory that a texture of `size` takes, beside the photo that is projected."""
    covered = len(surface.texels) * size**2 // surface.texels.size**2
    return BAND_BYTES * min(covered, BAND_TEXELS) + RESULT_BYTES * size**2


def _project(
    surface: UnwrappedMesh, photos: FullPhotos, size: int, gains: Floats, holdout: int, monitor: Monitor
) -> tuple[Halves, Flags, Bytes, DetailEnergy]:
    """Linear colours of the photos on a texture of `size`, where there are some, codes of its charts, and the energies of the detail."""
    reader, atlas, energy = PhotoProjector(photos, holdout), surface.atlas, DetailEnergy()
    edge = surface.texel_size * surface.texels.size / size
    colour, observed = np.zeros((size * size, 3), np.float16), np.zeros(size * size, np.bool_)
    charts = np.zeros(size * size, np.uint8)
    bands = max(1, -(-len(surface.texels) * size**2 // surface.texels.size**2 // BAND_TEXELS))
    rows = np.linspace(0, size, bands + 1).round().astype(int)
    for band in range(bands):
        part = int(rows[band]), int(rows[band + 1])
        texels = rasterise(atlas.uv, atlas.faces, size, part)
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
        fused = blender.result(gains)
        colour[texels.index], observed[texels.index] = fused.values, fused.observed
        charts[texels.index] = chart_codes(atlas.chart[texels.face])
        energy.add(blender, texels, part, PATCHES // bands, gains)
    return colour.reshape(size, size, 3), observed.reshape(size, size), charts.reshape(size, size), energy


def _refined(coarse: Floats, projected: Floats, observed: Flags, smooth: bool) -> Floats:
    """One channel: `coarse` (s, s) with the detail of the `projected` colours (n, n) where they are `observed` (n, n)."""
    small, large = coarse.shape, projected.shape
    known = observed.astype(np.float32)
    share = cv2.resize(known, small, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(projected * known, small, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    filled = fill_empty_texels(mean[..., None], share > 0, gutter=4)[..., 0]
    factor = np.clip((coarse + DETAIL_OFFSET) / (filled + DETAIL_OFFSET), 1 / MAX_RATIO, MAX_RATIO)
    if smooth:
        factor = cv2.GaussianBlur(factor, (0, 0), SMOOTH_TEXELS)
    detailed = (projected + DETAIL_OFFSET) * cv2.resize(factor, large, interpolation=cv2.INTER_LINEAR) - DETAIL_OFFSET
    return np.asarray(np.clip(np.where(observed, detailed, cv2.resize(coarse, large, interpolation=cv2.INTER_LINEAR)), 0, 1), np.float32)
