"""Encoding of linear textures to the 8-bit images of the asset, within a size budget.

Base colour and emission are coded in sRGB; occlusion-roughness-metallic (ORM) and the normal map are linear. If the asset would exceed its
size, first the low bits of the linear maps are dropped, then their resolution is halved; colours keep full precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.gltf.write import GltfTextures
from gsbake.imaging.png import encode_png
from gsbake.imaging.srgb import encode_bytes

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class PrecisionLevel:
    """Low bits dropped from ORM and from the normal map, the factor by which both are downsampled, and a description."""

    orm_bits: int
    normal_bits: int
    downsampling: int
    text: str


#: Rows of a texture that are coded at once: in double precision a large one takes gigabytes.
_ROWS = 256
#: Tried in order until the asset fits.
PRECISION_LEVELS = (
    PrecisionLevel(0, 0, 1, "full precision"),
    PrecisionLevel(2, 1, 1, "6-bit ORM, 7-bit normals"),
    PrecisionLevel(2, 1, 2, "6-bit ORM, 7-bit normals, both at half resolution"),
)


#: Megabytes of an asset whose maps all have the same size, and at most per texel by which a base colour is finer, in a PNG file.
USUAL_MEGABYTES, BYTES_PER_FINE_TEXEL = 5.0, 3


def size_limit(megabytes: float, edge: int, map_edge: int) -> float:
    """The size limit of an asset in megabytes: the one set, or if that is 0, what the `edge` of the base colour and that of the other
    maps call for."""
    return megabytes or USUAL_MEGABYTES + 1e-6 * BYTES_PER_FINE_TEXEL * max(0, edge**2 - map_edge**2)


@dataclass(frozen=True)
class TextureMaps:
    """The 8-bit maps (s, s, 3): base colour and emission coded in sRGB, ORM and normal map linear; the base colour may be finer.

    When roughness and metallic are constant, they are stored in `factors`, and `orm` (s, s) is occlusion only.
    """

    base_color: Bytes
    orm: Bytes
    normal: Bytes | None
    emissive: Bytes | None
    factors: tuple[float, float] | None = None


def quantise(base_color: NDArray[Any], orm: NDArray[Any], normal: NDArray[Any] | None, emissive: NDArray[Any] | None = None) -> TextureMaps:
    """Quantise linear textures (s, s, 3) to 8-bit maps."""
    emission = None if emissive is None else encode_bytes(np.asarray(emissive, np.float64))
    packed, factors = _to_8bit(orm), None
    if (packed[..., 1:] == packed[0, 0, 1:]).all():
        factors = (round(float(orm[0, 0, 1]), 3), round(float(orm[0, 0, 2]), 3))
        packed = np.ascontiguousarray(packed[..., 0])
    colour = np.empty(base_color.shape, np.uint8)
    for row in range(0, len(colour), _ROWS):
        colour[row : row + _ROWS] = encode_bytes(np.asarray(base_color[row : row + _ROWS], np.float64))
    return TextureMaps(colour, packed, None if normal is None else _to_8bit(normal), emission, factors)


def halved_to_fit(maps: TextureMaps, budget: int) -> TextureMaps:
    """The maps with a base colour of at most `budget` bytes as a PNG file: one that is finer than the other maps is halved, down to their
    size at most."""
    colour = maps.base_color
    while len(colour) > len(maps.orm) and colour.size > budget and len(encode_png(colour)) > budget:
        colour = _downsample(colour, 2)
    return replace(maps, base_color=colour)


def encode_within_budget(maps: TextureMaps, budget: int) -> tuple[GltfTextures, PrecisionLevel]:
    """PNG files of at most `budget` bytes in all at the first of `PRECISION_LEVELS` that fits, else at the last level."""
    base = encode_png(maps.base_color)
    emissive = None if maps.emissive is None else encode_png(maps.emissive)
    for level in PRECISION_LEVELS:
        orm = encode_png(reduce_precision(_downsample(maps.orm, level.downsampling), level.orm_bits))
        normal = None
        if maps.normal is not None:
            normal = encode_png(reduce_precision(_downsample_normals(maps.normal, level.downsampling), level.normal_bits))
        if len(base) + len(orm) + len(normal or b"") + len(emissive or b"") <= budget:
            break
    return GltfTextures(base, orm, normal, emissive), level


def _to_8bit(image: NDArray[Any]) -> Bytes:
    """Linear values 0..1 as 8-bit codes; 0.5 maps to 128, glTF's flat normal."""
    return np.asarray(np.floor(np.clip(np.asarray(image, np.float64), 0, 1) * 255 + 0.5), np.uint8)


def reduce_precision(image: Bytes, bits: int) -> Bytes:
    """Codes rounded to multiples of 2**bits around 128; 0 and 255 are preserved."""
    if bits == 0:
        return image
    step = 1 << bits
    rounded = np.clip(np.rint((image.astype(np.int32) - 128) / step) * step + 128, 0, 255)
    return np.where((image == 255) | (image == 0), image, rounded).astype(np.uint8)


def _downsample(image: Bytes, downsampling: int) -> Bytes:
    """The image downsampled by an area filter."""
    if downsampling == 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=1 / downsampling, fy=1 / downsampling, interpolation=cv2.INTER_AREA), np.uint8)


def _downsample_normals(normal: Bytes, downsampling: int) -> Bytes:
    """A normal map downsampled by an area filter, with renormalised vectors."""
    if downsampling == 1:
        return normal
    vector = normal.astype(np.float32) / 127.5 - 1
    mean = np.asarray(cv2.resize(vector, None, fx=1 / downsampling, fy=1 / downsampling, interpolation=cv2.INTER_AREA), np.float32)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-6)
    return _to_8bit(0.5 * mean + 0.5)
