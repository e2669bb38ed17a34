"""Light of photos and video frames that are coded for HDR screens: PQ and HLG (Recommendation ITU-R BT.2100) to linear sRGB.

HLG codes the light of the scene, PQ that of a screen. Both are divided by reference white (BT.2408: 203 cd/m², or 75 % of HLG's signal), so
that 1 is a white surface, as in other photos; what is brighter is clipped in 8-bit working photos. Codes of transfers and primaries are
those of Recommendation ITU-T H.273, which files carry.

OpenCV's FFmpeg hands out frames of such videos converted already: HLG as light of a screen of 1000 cd/m² (its OOTF is a power of the
luminance), both relative to reference white, in primaries of sRGB and with BT.1886's power as transfer, where sRGB's is expected.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.imaging.srgb import LUMINANCE, encode_bytes

Floats = NDArray[np.float32]

#: Transfers by their codes of H.273.
TRANSFERS = {16: "PQ", 18: "HLG"}
#: Reference white: PQ's in cd/m², HLG's signal.
PQ_WHITE, HLG_WHITE = 203.0, 0.75
#: Names by which files announce gain maps, and the bytes at their start in which they do.
_GAIN_MAPS, GAIN_MAP_SEARCH = (b"ns.adobe.com/hdr-gain-map", b"urn:iso:std:iso:ts:21496", b"photo:2020:aux:hdrgainmap"), 1 << 18
#: Primaries by their codes of H.273 → the matrix to those of sRGB (D65 in all). Others are taken for BT.2020, which BT.2100 asks for.
_SRGB = np.eye(3)
_FROM_BT2020 = np.array([[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]])
_FROM_P3 = np.array([[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098273]])
_TO_SRGB = {1: _SRGB, 12: _FROM_P3}
#: Power of BT.1886, and of HLG's OOTF for a screen of 1000 cd/m².
_BT1886, _OOTF = 2.4, 1.2


def _pq(signal: NDArray[Any]) -> NDArray[Any]:
    """cd/m² of PQ's signal (SMPTE ST 2084)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = signal ** (1 / m2)
    return np.asarray(10_000 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1))


def _hlg(signal: NDArray[Any]) -> NDArray[Any]:
    """Light of the scene (0..1) of HLG's signal."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def linear_light(coded: NDArray[Any], transfer: int, primaries: int) -> Floats:
    """Linear sRGB (h, w, 3), not negative, 1 = reference white, of pixels coded in 0..1 with a transfer of TRANSFERS."""
    signal = np.clip(coded, 0, 1)
    light = _pq(signal) / PQ_WHITE if TRANSFERS[transfer] == "PQ" else _hlg(signal) / _hlg(np.array(HLG_WHITE))
    return np.maximum(light @ _TO_SRGB.get(primaries, _FROM_BT2020).T, 0).astype(np.float32)


def has_gain_map(path: Path) -> bool:
    """Whether a photo has a gain map, which brightens it on HDR screens: Ultra HDR (JPEG), ISO 21496-1, Apple's HEIC."""
    with path.open("rb") as file:
        head = file.read(GAIN_MAP_SEARCH)
    return any(name in head for name in _GAIN_MAPS)


def frame_to_srgb(decoded: NDArray[np.uint8], transfer: int) -> NDArray[np.uint8]:
    """The frame (h, w, 3) in 8-bit sRGB that OpenCV decoded from a video with a transfer of TRANSFERS."""
    light = ((np.arange(256) / 255) ** _BT1886).astype(np.float32)[decoded]
    if TRANSFERS[transfer] == "HLG":
        luminance = light @ LUMINANCE
        light *= np.maximum(luminance, 1e-6)[..., None] ** np.float32(1 / _OOTF - 1)
    return encode_bytes(light)
