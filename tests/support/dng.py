"""A small undeveloped photo: an uncompressed DNG (Adobe, *Digital Negative Specification* 1.4)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Linear sRGB of XYZ (IEC 61966-2-1, D65).
XYZ_TO_SRGB = ((3.2404542, -1.5371385, -0.4985314), (-0.9692660, 1.8760108, 0.0415560), (0.0556434, -0.2040259, 1.0572252))


def write_dng(path: Path, linear: NDArray[np.float64], orientation: int = 1) -> None:
    """A DNG with a Bayer mosaic of the linear sRGB image (h, w, 3), of a camera whose primaries are those of sRGB."""
    height, width = linear.shape[:2]
    mosaic = np.empty((height, width), "<u2")
    for (dy, dx), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        mosaic[dy::2, dx::2] = np.round(65535 * linear[dy::2, dx::2, channel])
    matrix = [round(1e6 * v) for row in XYZ_TO_SRGB for v in row]
    short, long, text, byte, ratio, signed = 3, 4, 2, 1, 5, 10
    entries: dict[int, tuple[int, list[Any] | bytes]] = {
        254: (long, [0]), 256: (long, [width]), 257: (long, [height]), 258: (short, [16]), 259: (short, [1]), 262: (short, [32803]),
        271: (text, b"Maker\0"), 272: (text, b"Camera 1\0"), 273: (long, [0]), 274: (short, [orientation]), 277: (short, [1]),
        278: (long, [height]), 279: (long, [mosaic.nbytes]), 284: (short, [1]), 33421: (short, [2, 2]), 33422: (byte, [0, 1, 1, 2]),
        34665: (long, [0]), 50706: (byte, [1, 4, 0, 0]), 50708: (text, b"Maker Camera 1\0"), 50714: (long, [0]), 50717: (long, [65535]),
        50721: (signed, [n for v in matrix for n in (v, 1_000_000)]), 50728: (ratio, [1, 1] * 3), 50778: (short, [21]),
    }  # fmt: skip
    formats, sizes = {short: "H", long: "I", byte: "B", ratio: "I", signed: "i"}, {ratio: 2, signed: 2}
    packed = {
        tag: (kind, values if isinstance(values, bytes) else struct.pack(f"<{len(values)}{formats[kind]}", *values))
        for tag, (kind, values) in entries.items()
    }
    start = 8
    exif_at = start + 2 + 12 * len(packed) + 4
    data_at = exif_at + 2 + 12 + 4
    blobs, places = b"", {}
    for tag, (_, content) in packed.items():
        if len(content) > 4:
            places[tag] = data_at + len(blobs)
            blobs += content + b"\0" * (len(content) % 2)
    pixels_at = data_at + len(blobs)
    packed[273], packed[34665] = (long, struct.pack("<I", pixels_at)), (long, struct.pack("<I", exif_at))
    body = struct.pack("<H", len(packed))
    for tag, (kind, content) in sorted(packed.items()):
        unit = {short: 2, long: 4, text: 1, byte: 1, ratio: 4, signed: 4}[kind]
        count = len(content) // unit // sizes.get(kind, 1)
        body += struct.pack("<HHI", tag, kind, count) + (struct.pack("<I", places[tag]) if tag in places else content.ljust(4, b"\0"))
    body += struct.pack("<I", 0)
    exif = struct.pack("<HHHIII", 1, 0xA405, short, 1, 26, 0)
    path.write_bytes(b"II*\0" + struct.pack("<I", start) + body + exif + blobs + mosaic.tobytes())
