"""Colours of a photo by what its file says of them: an ICC profile, or a coding for HDR screens."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos import hdr, icc

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

#: Rows that are converted at once, which bounds the memory.
_BLOCK_ROWS = 256


def to_srgb(pixels: NDArray[Any], tags: Mapping[str, Any]) -> Bytes | Floats:
    """Colours (h, w, 3), 8-bit or 32-bit coded in 0..1 (of a 16-bit file), in 8-bit sRGB or 32-bit linear sRGB.

    `tags` are OpenImageIO's. Colours without a tag are sRGB. A profile that is broken is ignored: it does not make the photo unusable.
    """
    profile, coding = _rgb_profile(tags), tags.get("CICP")
    if coding is None and profile is not None:
        coding = icc.coding(profile)
    if coding is not None and len(coding) >= 2 and int(coding[1]) in hdr.TRANSFERS:
        primaries, transfer = int(coding[0]), int(coding[1])
        light = _in_blocks(pixels, lambda coded: hdr.linear_light(coded, transfer, primaries))
        assert light is not None, "it has no refusal"
        return light
    if profile is not None and pixels.dtype == np.float32:
        light = _in_blocks(pixels, lambda coded: icc.linear_light(profile, coded))
        if light is not None:
            return light
    rounded = pixels if pixels.dtype == np.uint8 else np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    return np.asarray(rounded, np.uint8) if profile is None else _by_littlecms(np.ascontiguousarray(rounded), profile)


def _in_blocks(pixels: NDArray[Any], convert: Callable[[Floats], Floats | None]) -> Floats | None:
    """The pixels converted in blocks of rows, coded in 0..1; None where a block cannot be."""
    out = np.empty(pixels.shape, np.float32)
    for start in range(0, len(pixels), _BLOCK_ROWS):
        rows = pixels[start : start + _BLOCK_ROWS].astype(np.float32)
        done = convert(rows / np.float32(255) if pixels.dtype == np.uint8 else rows)
        if done is None:
            return None
        out[start : start + _BLOCK_ROWS] = done
    return out


def _rgb_profile(tags: Mapping[str, Any]) -> bytes | None:
    """The embedded ICC profile of RGB colours other than sRGB; None where there is none."""
    profile = tags.get("ICCProfile")
    if profile is None or "srgb" in str(tags.get("ICCProfile:profile_description", "")).lower():
        return None
    if not str(tags.get("ICCProfile:color_space", "")).strip().upper().startswith("RGB"):
        return None
    return np.asarray(profile).astype(np.uint8).tobytes()


def _by_littlecms(rgb: Bytes, profile: bytes) -> Bytes:
    """8-bit colours from any RGB profile (Display P3 of phones, Adobe RGB of cameras) to sRGB."""
    from PIL import Image, ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        out = ImageCms.profileToProfile(Image.fromarray(rgb), source, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError, OverflowError):
        return rgb
    return rgb if out is None else np.asarray(out, np.uint8)
