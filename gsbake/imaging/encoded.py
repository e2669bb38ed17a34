"""Encoded images of glTF files (PNG, JPEG, WebP, KTX2): their format and size from the header, and their pixels.

`decode_image` runs in this process: it is for what gsbake has encoded itself. Images of files are decoded by `image_process`, in a child.
Either way a header that states more than the memory that is free is refused before a decoder sees the file.

PNG: W3C *Portable Network Graphics*, 11.2.1. JPEG: ITU-T T.81, B.2.2. WebP: RFC 9649, 2.5 to 2.7. KTX2: `ktx2`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.imaging import ktx2
from gsbake.memory_budget import check

#: Most bytes that deflate makes of one (zlib's technical details: 1032, and what the file has besides).
MAX_DEFLATE = 1032
#: Most pixels of a JPEG for a byte: each block of 64 has a DC coefficient of at least one bit (ITU-T T.81, F.1.2.1).
MAX_JPEG_PIXELS = 512
#: Channels of a PNG by its colour type.
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
#: Bytes per pixel while 8-bit pixels are decoded and made RGBA: what the decoder holds, its pixels, planes, and the result.
PIXEL_BYTES = 24


@dataclass(frozen=True)
class ImageSize:
    """What an image's header states: `format` ("png", "jpeg", "webp", "ktx2"), `width`, `height`, `bits` per channel, and the `least` bytes
    that a file of PNG or JPEG with so many pixels has."""

    format: str
    width: int
    height: int
    bits: int = 8
    least: int = 0

    @property
    def needed(self) -> int:
        """Bytes that decoding takes."""
        return self.width * self.height * PIXEL_BYTES * max(1, self.bits // 8)


def image_format(content: bytes) -> str:
    """The format of an encoded image: "png", "jpeg", "webp", "ktx2" or "unknown"."""
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        return "png"
    if content[:3] == b"\xff\xd8\xff":
        return "jpeg"
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        return "webp"
    return "ktx2" if content[:12] == ktx2.MAGIC else "unknown"


def image_size(content: bytes, name: str) -> ImageSize:
    """The header of an image. Raises BadInputError, which names `name`, for another format, and for more pixels than are decoded."""
    form = image_format(content)
    try:
        found = ImageSize(form, *_READERS[form](content))
    except (KeyError, struct.error, IndexError, ValueError):
        raise BadInputError(f"{name} cannot be decoded; it must be PNG, JPEG or WebP.") from None
    if not (0 < found.width <= ktx2.MAX_EDGE and 0 < found.height <= ktx2.MAX_EDGE):
        stated = f"{found.width} × {found.height} pixels"
        raise BadInputError(f"{name} cannot be decoded: it states {stated}, and textures have 1 to {ktx2.MAX_EDGE} a side; reduce it.")
    check(found.needed, name)
    if len(content) < found.least:
        stated = f"{found.width} × {found.height} pixels in {len(content)} bytes"
        raise BadInputError(f"{name} cannot be decoded: its data is cut off ({stated}); export it again.")
    return found


def decode_image(content: bytes, name: str) -> NDArray[np.uint8]:
    """Pixels (h, w, 4) 8-bit RGBA of an image that gsbake encoded. Raises BadInputError, which names `name`."""
    image_size(content, name)
    return as_rgba(decode_pixels(content, name), name)


def decode_pixels(content: bytes, name: str) -> NDArray[Any]:
    """Pixels (h, w[, c]) as they are stored, colours in the order BGR. Raises BadInputError, which names `name`."""
    if image_format(content) == "ktx2":
        if not ktx2.available():
            raise BadInputError(f"{name} is a KTX2 image, which the package alktx2 reads: pip install 'gsbake[web]', or export it without.")
        try:
            return np.ascontiguousarray(ktx2.decode_ktx2(content)[..., [2, 1, 0, 3]])
        except ValueError as error:
            raise BadInputError(f"{name} is a KTX2 image that cannot be decoded: {error}.") from error
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise BadInputError(f"{name} cannot be decoded; it must be PNG, JPEG or WebP.")
    return pixels


def as_rgba(pixels: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """Stored pixels (h, w[, 1 to 4]) of 8 or 16 bits as 8-bit RGBA (h, w, 4)."""
    if pixels.dtype == np.uint16:
        pixels = (pixels.astype(np.uint32) * 255 // 65535).astype(np.uint8)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype != np.uint8:
        raise BadInputError(f"{name} has {pixels.dtype} pixels; glTF images have 8 or 16 bits.")
    opaque = np.full(pixels.shape[:2], 255, np.uint8)
    match pixels.shape[2]:
        case 1:
            planes = (pixels[..., 0], pixels[..., 0], pixels[..., 0], opaque)
        case 2:
            planes = (pixels[..., 0], pixels[..., 0], pixels[..., 0], pixels[..., 1])
        case 3:
            planes = (pixels[..., 2], pixels[..., 1], pixels[..., 0], opaque)
        case _:
            planes = (pixels[..., 2], pixels[..., 1], pixels[..., 0], pixels[..., 3])
    return np.ascontiguousarray(np.stack(planes, -1), np.uint8)


def _png(content: bytes) -> tuple[int, int, int, int]:
    width, height, bits, colours = struct.unpack_from(">IIBB", content, 16)
    if content[12:16] != b"IHDR":
        raise ValueError
    return width, height, bits, math.ceil(height * (width * bits * _PNG_CHANNELS[colours] // 8) / MAX_DEFLATE)


def _jpeg(content: bytes) -> tuple[int, int, int, int]:
    """The size in the first frame header: segments before it are skipped."""
    at = 2
    while True:
        if content[at] != 0xFF:
            raise ValueError
        marker = content[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # without a segment
            at += 2
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, height, width = struct.unpack_from(">BHH", content, at + 4)
            return width, height, bits, math.ceil(width * height / MAX_JPEG_PIXELS)
        else:
            at += 2 + max(2, struct.unpack_from(">H", content, at + 2)[0])


def _webp(content: bytes) -> tuple[int, int]:
    kind = content[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (24, 27))
        return width, height
    if kind == b"VP8L" and content[20] == 0x2F:
        (packed,) = struct.unpack_from("<I", content, 21)
        return 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
    if kind == b"VP8 " and content[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", content, 26)
        return width & 0x3FFF, height & 0x3FFF
    raise ValueError


_READERS: dict[str, Any] = {"png": _png, "jpeg": _jpeg, "webp": _webp, "ktx2": ktx2.ktx2_size}
