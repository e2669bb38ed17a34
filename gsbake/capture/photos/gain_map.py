"""Gain maps of JPEG photos (Ultra HDR): the light that the photo shows on an HDR screen, linear.

The base photo is tone-mapped for ordinary screens, often locally, so its values are not proportional to light. A second, smaller JPEG
behind it holds the logarithm of what each pixel was divided by; its XMP says how it is coded. Adobe, *Gain map specification*, 1.0;
Android, *Ultra HDR image format*, 1.1. Gain maps coded otherwise (only by ISO 21496-1, in HEIC, of a base that is HDR) are not used.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.hdr import has_gain_map
from gsbake.errors import BadInputError
from gsbake.imaging.encoded import image_size
from gsbake.imaging.srgb import decode_bytes

Floats = NDArray[np.float32]

SUFFIXES = (".jpg", ".jpeg")
_XMP = b"http://ns.adobe.com/xap/1.0/\0"
#: Markers without a segment: fill bytes, TEM, restarts and the start of the image.
_BARE = {0x01, *range(0xD0, 0xD9), 0xFF}
_END, _SCAN = 0xD9, 0xDA
#: Largest gain in stops, and largest offset: those of no screen.
MAX_STOPS, MAX_OFFSET = 16.0, 1.0
#: Largest number of any kind.
MAX_NUMBER = 1e6
#: Images behind the photo that are looked at.
MAX_IMAGES = 8
#: Rows that are converted at once.
_ROWS = 256


@dataclass(frozen=True)
class GainMap:
    """`values` (h, w, 3) 8-bit; per channel (3,) the stops `low` … `high` that they stand for, `gamma`, and the offsets of both photos."""

    values: NDArray[np.uint8]
    low: Floats
    high: Floats
    gamma: Floats
    offset_sdr: Floats
    offset_hdr: Floats

    def apply(self, photo: NDArray[np.uint8]) -> Floats:
        """Linear sRGB (h, w, 3) of a photo (h, w, 3) in 8-bit sRGB, not negative; 1 is its white, highlights are brighter."""
        height, width = photo.shape[:2]
        table = np.arange(256, dtype=np.float32)[:, None] / np.float32(255)
        stops = self.low + (self.high - self.low) * table ** (1 / self.gamma)
        coded = np.take_along_axis(stops, self.values.reshape(-1, 3).astype(np.intp), 0).reshape(self.values.shape)
        gain = np.asarray(cv2.resize(np.exp2(coded.astype(np.float32)), (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
        for start in range(0, height, _ROWS):
            rows = slice(start, start + _ROWS)
            gain[rows] = np.maximum((decode_bytes(photo[rows]) + self.offset_sdr) * gain[rows] - self.offset_hdr, 0)
        return gain


def read_gain_map(path: Path, pixels: int) -> GainMap | None:
    """The gain map of a JPEG of so many pixels; None where there is none, it is damaged, larger than the photo, or coded otherwise."""
    if path.suffix.lower() not in SUFFIXES or not has_gain_map(path):
        return None
    data = path.read_bytes()
    start = _end_of(data, 0)
    for _ in range(MAX_IMAGES):
        start = data.find(b"\xff\xd8\xff", start) if start >= 0 else -1
        end = _end_of(data, start) if start >= 0 else -1
        if end < 0:
            return None
        image = data[start:end]
        numbers = _numbers(_xmp(image))
        if numbers is not None:
            return _decoded(image, numbers, pixels)
        start = end
    return None


def _segments(data: bytes, start: int) -> list[tuple[int, int, int]]:
    """(marker, start and end of its content) of the segments of the JPEG at `start`, up to the first scan."""
    found, at = [], start + 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _BARE:
            at += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        found.append((marker, at + 4, at + 2 + length))
        at += 2 + max(length, 2)
        if marker in (_SCAN, _END):
            break
    return found


def _end_of(data: bytes, start: int) -> int:
    """Index behind the JPEG at `start`; −1 where it does not end. Coded data hold 0xFF only before 0 and restart markers."""
    segments = _segments(data, start)
    if not segments or segments[-1][0] != _SCAN:
        return -1
    at = segments[-1][2]
    while (at := data.find(b"\xff", at)) >= 0 and at + 1 < len(data):
        marker = data[at + 1]
        if marker == _END:
            return at + 2
        at += 1 if marker == 0xFF else 2
        if marker not in (0, 0xFF) and marker not in _BARE:  # a segment between the scans of a progressive JPEG
            at += int.from_bytes(data[at : at + 2], "big")
    return -1


def _xmp(image: bytes) -> str:
    """The XMP packet of a JPEG; empty where there is none."""
    for marker, first, last in _segments(image, 0):
        if marker == 0xE1 and image[first : first + len(_XMP)] == _XMP:
            return image[first + len(_XMP) : last].decode("utf-8", errors="replace")
    return ""


def _numbers(xmp: str) -> dict[str, Floats] | None:
    """The gain map's numbers (3,) in XMP; None where it has none, or such as no gain map has."""
    if 'hdrgm:Version="' not in xmp or "hdrgm:GainMapMax" not in xmp or re.search(r'BaseRenditionIsHDR="?>?\s*True', xmp):
        return None
    found = {}
    usual = {"GainMapMin": 0.0, "GainMapMax": 1.0, "Gamma": 1.0, "OffsetSDR": 1 / 64, "OffsetHDR": 1 / 64}
    for name, default in usual.items():
        single = re.search(rf'hdrgm:{name}\s*=\s*"([^"]{{1,60}})"', xmp)
        several = re.search(rf"<hdrgm:{name}>(.{{1,600}}?)</hdrgm:{name}>", xmp, re.DOTALL)
        texts = [single[1]] if single else re.findall(r"<rdf:li>([^<]{1,60})</rdf:li>", several[1]) if several else [str(default)]
        try:
            values = np.array([float(text) for text in texts])
        except ValueError:
            return None
        if len(values) not in (1, 3) or not (np.abs(values) <= MAX_NUMBER).all():
            return None
        found[name] = np.broadcast_to(values, 3).astype(np.float32)
    stops, offsets = np.concatenate([found["GainMapMin"], found["GainMapMax"]]), np.concatenate([found["OffsetSDR"], found["OffsetHDR"]])
    if np.abs(stops).max() > MAX_STOPS or found["Gamma"].min() < 1e-2 or np.abs(offsets).max() > MAX_OFFSET:
        return None
    if (found["GainMapMin"] > found["GainMapMax"]).any():
        return None
    return found


def _decoded(image: bytes, numbers: dict[str, Floats], most: int) -> GainMap | None:
    """The map of a JPEG of at most so many pixels; None for a damaged one."""
    try:
        size = image_size(image, "the gain map")
    except BadInputError:
        return None
    if size.width * size.height > most:
        return None
    values = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if values is None:
        return None
    rgb = np.ascontiguousarray(values[..., ::-1], np.uint8)
    return GainMap(rgb, *(numbers[name] for name in ("GainMapMin", "GainMapMax", "Gamma", "OffsetSDR", "OffsetHDR")))
