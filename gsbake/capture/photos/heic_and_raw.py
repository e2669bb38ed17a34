"""Photos of telephones (HEIC, HEIF) and undeveloped photos of cameras (RAW), by libraries that are optional.

HEIC holds sRGB or an ICC profile, as JPEG does, or is coded for HDR screens (PQ, HLG). RAW is developed to linear values with the white
balance that the camera wrote, without brightening, so that photos of one exposure keep their relation.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.hdr import TRANSFERS

#: File name suffixes by the package that reads them, and the extra of gsbake that installs it.
HEIC_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
RAW_SUFFIXES = frozenset({".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw"})
SUFFIXES = HEIC_SUFFIXES | RAW_SUFFIXES
#: EXIF tags that the rest of gsbake reads: numbers of the image's directory and of EXIF's own, and names as OpenImageIO calls them.
_IMAGE_TAGS = {0x010F: "Make", 0x0110: "Model"}
_EXIF_TAGS = {
    0x920A: "Exif:FocalLength", 0xA405: "Exif:FocalLengthIn35mmFilm", 0xA20E: "Exif:FocalPlaneXResolution",
    0xA210: "Exif:FocalPlaneResolutionUnit", 0xA002: "Exif:PixelXDimension", 0xA003: "Exif:PixelYDimension",
    0xA431: "Exif:BodySerialNumber", 0x9209: "Exif:Flash",
    0x829A: "ExposureTime", 0x829D: "FNumber", 0x8827: "Exif:PhotographicSensitivity",
}  # fmt: skip
_GPS_TAGS = {
    1: "GPS:LatitudeRef", 2: "GPS:Latitude", 3: "GPS:LongitudeRef", 4: "GPS:Longitude", 5: "GPS:AltitudeRef", 6: "GPS:Altitude",
}  # fmt: skip
_EXIF_DIRECTORY, _GPS_DIRECTORY = 0x8769, 0x8825


class MissingReaderError(Exception):
    """The library that reads a format is not installed; the message says how to install it."""


@dataclass(frozen=True)
class Developed:
    """An upright photo: `pixels` (h, w, 3 or 4), 8-bit sRGB-coded or 32-bit linear, its `icc_profile` or none, and EXIF `tags`; `hdr`,
    primaries and transfer (codes of H.273) of a photo for HDR screens, whose pixels are coded in 8 or 16 bits."""

    pixels: NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]
    icc_profile: bytes | None
    tags: dict[str, Any]
    hdr: tuple[int, int] | None = None


def _library(name: str, extra: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise MissingReaderError(f"reading it needs a library: pip install 'gsbake[{extra}]'") from None


def upright_size(path: Path) -> tuple[int, int, int, int]:
    """Width, height, channels and bytes per channel after decoding, from the file's header; raises what `develop` raises."""
    if path.suffix.lower() in HEIC_SUFFIXES:
        image = _library("pi_heif", "heic").open_heif(path, convert_hdr_to_8bit=True)
        return (*image.size, len(image.mode), 1 if _hdr_coding(image) is None else 4)
    with _library("rawpy", "raw").imread(str(path)) as raw:
        width, height = raw.sizes.width, raw.sizes.height
        return (height, width, 3, 4) if raw.sizes.flip in (5, 6) else (width, height, 3, 4)


def _hdr_coding(image: Any) -> tuple[int, int] | None:
    """Primaries and transfer of a HEIC photo for HDR screens; None for others."""
    coding = image.info.get("nclx_profile") or {}
    transfer = int(coding.get("transfer_characteristics", 0))
    return (int(coding.get("color_primaries", 0)), transfer) if transfer in TRANSFERS and not image.info.get("icc_profile") else None


def develop(path: Path) -> Developed:
    """Decode a photo. Raises MissingReaderError, and what the library raises for a file that it cannot read."""
    if path.suffix.lower() in HEIC_SUFFIXES:
        # The pixels are copied: the library's own memory ends with `image`.
        image = _library("pi_heif", "heic").open_heif(path, convert_hdr_to_8bit=True)
        coding = _hdr_coding(image)
        if coding is not None:
            image = _library("pi_heif", "heic").open_heif(path, convert_hdr_to_8bit=False)
        return Developed(np.array(image), image.info.get("icc_profile"), _exif_tags(image.info.get("exif")), coding)
    rawpy = _library("rawpy", "raw")
    with rawpy.imread(str(path)) as raw:
        linear = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=16, gamma=(1, 1), output_color=rawpy.ColorSpace.sRGB)
    with path.open("rb") as file:
        return Developed(linear.astype(np.float32) / np.float32(65535), None, _exif_tags(file.read(1 << 20)))


def _exif_tags(data: bytes | None) -> dict[str, Any]:
    """Tags of EXIF data, or of the start of a file that is built like EXIF (TIFF: DNG, NEF, CR2, ARW …); {} where there are none."""
    from PIL import Image

    if not data:
        return {}
    exif = Image.Exif()
    try:
        exif.load(data)
        found = {name: exif.get(number) for number, name in _IMAGE_TAGS.items()}
        directory = exif.get_ifd(_EXIF_DIRECTORY)
        found |= {name: directory.get(number) for number, name in _EXIF_TAGS.items()}
        directory = exif.get_ifd(_GPS_DIRECTORY)
        found |= {name: directory.get(number) for number, name in _GPS_TAGS.items()}
        return {name: _plain(value) for name, value in found.items() if value is not None}
    except Exception:  # damaged metadata does not make the photo unusable
        return {}


def _plain(value: Any) -> str | float | tuple[float, ...]:
    """A tag's value without Pillow's types; a byte is a number."""
    if isinstance(value, str):
        return value
    if isinstance(value, bytes):
        return float(value[0])
    return tuple(map(float, value)) if isinstance(value, tuple) else float(value)
