"""ICC profiles of RGB photos by matrix and curves (ICC.1:2022), in floating point: 16-bit values keep their steps.

littleCMS, through Pillow, converts the others, and 8-bit photos.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Columns of sRGB's primaries under D50, the white of profiles (IEC 61966-2-1, adapted by Bradford's matrix, as its profiles have them).
_SRGB_D50 = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
_HEADER, _ENTRY = 128, 12
#: Most tags of a profile that are looked at.
_MAX_TAGS = 200


def tags(profile: bytes) -> dict[bytes, memoryview]:
    """Content of each tag of a profile, without a copy, since tags may overlap; {} for what is none."""
    if len(profile) < _HEADER + 4:
        return {}
    count = min(int.from_bytes(profile[_HEADER : _HEADER + 4], "big"), _MAX_TAGS)
    found = {}
    for place in range(_HEADER + 4, min(_HEADER + 4 + _ENTRY * count, len(profile) - _ENTRY + 1), _ENTRY):
        name, offset, size = struct.unpack_from(">4sII", profile, place)
        found[name] = memoryview(profile)[offset : offset + size]
    return found


def coding(profile: bytes) -> tuple[int, int] | None:
    """Primaries and transfer, codes of H.273, that a profile's tag `cicp` states; None where it has none."""
    content = tags(profile).get(b"cicp", memoryview(b""))
    return (content[8], content[9]) if len(content) >= 12 else None


def linear_light(profile: bytes, coded: Floats) -> Floats | None:
    """Linear sRGB (h, w, 3), with negative values for colours outside it, of pixels coded in 0..1; None where the profile is no matrix with
    curves, or a broken one."""
    found = tags(profile)
    if profile[16:24] != b"RGB XYZ " or b"A2B0" in found:
        return None
    try:
        columns = [struct.unpack_from(">4s4x3i", found[name]) for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        matrix = np.linalg.inv(_SRGB_D50) @ np.array([column[1:] for column in columns]).T / 65536
        with np.errstate(all="ignore"):  # curves of strangers; what is not finite is refused below
            planes = [_curve(found[name], coded[..., k]) for k, name in enumerate((b"rTRC", b"gTRC", b"bTRC"))]
            out = np.stack(planes, -1) @ matrix.T
    except (KeyError, struct.error, ValueError):
        return None
    return out.astype(np.float32) if np.isfinite(out).all() else None


def _curve(content: memoryview, x: NDArray[Any]) -> NDArray[Any]:
    """Values of a curve (`curv` or `para`) at x in 0..1. Raises struct.error or ValueError for one that is none."""
    if content[:4] == b"curv":
        (count,) = struct.unpack_from(">I", content, 8)
        if count == 0:
            return x
        if count == 1:
            return np.asarray(x ** (struct.unpack_from(">H", content, 12)[0] / 256))
        table = np.frombuffer(content, ">u2", count, 12).astype(np.float64) / 65535
        return np.interp(x, np.linspace(0, 1, count), table)
    if content[:4] != b"para":
        raise ValueError("not a curve")
    (kind,) = struct.unpack_from(">H", content, 8)
    if kind > 4:
        raise ValueError("not a parametric curve")
    values = [value / 65536 for value in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", content, 12)]
    g, a, b, c, d, e, f = values + [0.0] * (7 - len(values))
    if kind == 0:
        return np.asarray(x**g)
    power = np.maximum(a * x + b, 0) ** g
    return np.asarray(power + c if kind <= 2 else np.where(x >= d, power + e, c * x + f))
