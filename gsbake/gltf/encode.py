"""Linear masters to the 8-bit images of the asset, as small as the budget asks and no smaller.

Base colour and emission are coded in sRGB; occlusion-roughness-metallic and the normal map stay linear. If the asset would exceed its size,
the low bits of the linear maps go first, then their resolution; the colours are never touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.gltf.write import GltfImages
from gsbake.imaging.png import encode_png
from gsbake.imaging.srgb import encode_bytes

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Saving:
    """One rung of the ladder: low bits dropped from ORM and from the normal map, and by how much both are reduced in size."""

    orm_bits: int
    normal_bits: int
    shrink: int
    text: str


#: Tried in order until the asset fits.
LADDER = (
    Saving(0, 0, 1, "full precision"),
    Saving(2, 1, 1, "6-bit ORM, 7-bit normals"),
    Saving(2, 1, 2, "6-bit ORM, 7-bit normals, both at half resolution"),
)


@dataclass(frozen=True)
class Sheets:
    """The 8-bit maps (s, s, 3): base colour and emission coded in sRGB, ORM and normal map linear.

    Where roughness and metallic are one number all over, they are `constants` instead, and `orm` (s, s) is occlusion alone.
    """

    base_color: Bytes
    orm: Bytes
    normal: Bytes | None
    emissive: Bytes | None
    constants: tuple[float, float] | None = None


def quantise(base_color: NDArray[Any], orm: NDArray[Any], normal: NDArray[Any] | None, emissive: NDArray[Any] | None = None) -> Sheets:
    """Masters (s, s, 3) as 8-bit maps."""
    glow = None if emissive is None else encode_bytes(np.asarray(emissive, np.float64))
    packed, constants = _linear(orm), None
    if (packed[..., 1:] == packed[0, 0, 1:]).all():
        constants = (round(float(orm[0, 0, 1]), 3), round(float(orm[0, 0, 2]), 3))
        packed = np.ascontiguousarray(packed[..., 0])
    return Sheets(encode_bytes(np.asarray(base_color, np.float64)), packed, None if normal is None else _linear(normal), glow, constants)


def encode_within(sheets: Sheets, budget: int) -> tuple[GltfImages, Saving]:
    """PNG files whose sizes sum to at most `budget` bytes if any rung of `LADDER` reaches that, else those of the last rung."""
    base = encode_png(sheets.base_color)
    glow = None if sheets.emissive is None else encode_png(sheets.emissive)
    for saving in LADDER:
        orm = encode_png(_coarser(_smaller(sheets.orm, saving.shrink), saving.orm_bits))
        normal = None
        if sheets.normal is not None:
            normal = encode_png(_coarser(_shorter(sheets.normal, saving.shrink), saving.normal_bits))
        if len(base) + len(orm) + len(normal or b"") + len(glow or b"") <= budget:
            break
    return GltfImages(base, orm, normal, glow), saving


def _linear(image: NDArray[Any]) -> Bytes:
    """Linear values 0..1 as 8-bit codes; 0.5 becomes 128, glTF's flat normal."""
    return np.asarray(np.floor(np.clip(np.asarray(image, np.float64), 0, 1) * 255 + 0.5), np.uint8)


def _coarser(image: Bytes, bits: int) -> Bytes:
    """Codes rounded to multiples of 2**bits around 128, with both ends of the range kept."""
    if bits == 0:
        return image
    step = 1 << bits
    rounded = np.clip(np.rint((image.astype(np.int32) - 128) / step) * step + 128, 0, 255)
    return np.where((image == 255) | (image == 0), image, rounded).astype(np.uint8)


def _smaller(image: Bytes, shrink: int) -> Bytes:
    """The image reduced by an area filter."""
    if shrink == 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA), np.uint8)


def _shorter(normal: Bytes, shrink: int) -> Bytes:
    """A normal map reduced by an area filter, its vectors at unit length again."""
    if shrink == 1:
        return normal
    vector = normal.astype(np.float32) / 127.5 - 1
    mean = np.asarray(cv2.resize(vector, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA), np.float32)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-6)
    return _linear(0.5 * mean + 0.5)
