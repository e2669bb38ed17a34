"""KTX2 images with Basis Universal's codecs ETC1S and UASTC, by the package alktx2 (extra `web`).

The bytes depend on the pixels only: one thread encodes, because with several the supercompressed blocks differ between runs.
Khronos *KTX File Format Specification 2.0*; *KHR_texture_basisu*.
"""

from __future__ import annotations

import importlib.util
import struct
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
#: Largest edge that is decoded, in pixels: no graphics processor takes a larger texture.
MAX_EDGE = 16_384
#: Effort of the encoders, 0..10, and zstd's level for UASTC.
EFFORT, ZSTD_LEVEL = 2, 18
Codec = Literal["etc1s", "uastc"]


def available() -> bool:
    """Whether the package is installed."""
    return importlib.util.find_spec("alktx2") is not None


def encode_ktx2(pixels: NDArray[np.uint8], codec: Codec, quality: int, srgb: bool) -> bytes:
    """Encode 8-bit grey (h, w) or RGB (h, w, 3) with all mip levels; h and w are multiples of four. `quality` 1..100."""
    import alktx2

    image = np.asarray(pixels, np.uint8)
    rgb = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image
    rgba = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    height, width = rgb.shape[:2]
    options: dict[str, Any] = {"zstd_supercompression_level": ZSTD_LEVEL} if codec == "uastc" else {}
    return bytes(
        alktx2.encode_raw_rgba_to_ktx2(
            rgba.tobytes(), width, height, False, codec=codec, quality=quality, effort=EFFORT, srgb=srgb, linear=not srgb, mipmaps=True,
            threads=1, **options,
        )
    )  # fmt: skip


def ktx2_size(content: bytes) -> tuple[int, int]:
    """Width and height in the header. Raises ValueError when there is none."""
    if content[:12] != MAGIC or len(content) < 80:
        raise ValueError("it is not a KTX2 file")
    width, height = struct.unpack_from("<II", content, 20)
    return int(width), int(height)


def decode_ktx2(content: bytes) -> NDArray[np.uint8]:
    """Pixels (h, w, 4) 8-bit RGBA of the largest level. Raises ValueError for what is not a Basis Universal image of a plausible size."""
    import alktx2

    width, height = ktx2_size(content)
    if not (0 < width <= MAX_EDGE and 0 < height <= MAX_EDGE):
        raise ValueError(f"it states {width} × {height} pixels")
    try:
        png, _ = alktx2.decode_ktx2_to_bytes(content, format="png")
    except RuntimeError as error:
        raise ValueError(f"its data are damaged or not of Basis Universal ({error})") from error
    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.shape != (height, width, 4):
        raise ValueError("its data do not have the size in the header")
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3]], np.uint8)
