"""Focal length in pixels, exposure, the flash, and the position by satellite navigation, from EXIF (CIPA DC-008, "Exif 2.32").

The focal length only initialises structure from motion: photos get cropped and resized without an update of their EXIF.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from blake3 import blake3

#: Diagonal of the 36 x 24 mm frame that the 35 mm equivalent refers to (CIPA DCG-001).
FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)
#: Aspect ratios of full sensors; a photo of any other aspect ratio was cropped.
SENSOR_ASPECTS = (4 / 3, 3 / 2, 16 / 9)
#: What EXIF has for this ISO speed and all higher ones.
MAX_SPEED = 65535
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def _number(tags: Mapping[str, Any], *names: str) -> float | None:
    for name in names:
        value = tags.get(name)
        if isinstance(value, int | float) and math.isfinite(value) and value > 0:
            return float(value)
    return None


def is_cropped(width: int, height: int) -> bool:
    """Whether a photo's aspect ratio differs by more than 1 % from that of every full sensor."""
    aspect = max(width, height) / min(width, height)
    return all(abs(aspect / known - 1) > 0.01 for known in SENSOR_ASPECTS)


def written_size(tags: Mapping[str, Any]) -> tuple[int, int] | None:
    """Longer and shorter side in pixels that the camera wrote; None where EXIF does not have both."""
    sides = [_number(tags, f"Exif:Pixel{axis}Dimension") for axis in "XY"]
    known = [round(side) for side in sides if side is not None]
    return (max(known), min(known)) if len(known) == 2 and min(known) >= 1 else None


def is_recropped(written: Sequence[int] | None, size: tuple[int, int]) -> bool:
    """Whether a photo has another aspect ratio, by more than 1 %, than its camera wrote."""
    return written is not None and abs(max(size) / min(size) * min(written) / max(written) - 1) > 0.01


def focal_pixels(tags: Mapping[str, Any], width: int, height: int) -> float | None:
    """Focal length in pixels of a photo of width x height, or None where EXIF does not determine it.

    `tags` are OpenImageIO's attributes by name. The 35 mm equivalent takes precedence over the sensor width computed from the focal plane
    resolution, which refers to the pixels that the camera wrote (`PixelXDimension`). None for cropped photos.
    """
    if is_cropped(width, height) or is_recropped(written_size(tags), (width, height)):
        return None
    diagonal = math.hypot(width, height)
    equivalent = _number(tags, "Exif:FocalLengthIn35mmFilm")
    if equivalent is not None:
        return equivalent / FULL_FRAME_DIAGONAL * diagonal
    focal = _number(tags, "Exif:FocalLength")
    per_unit = _number(tags, "Exif:FocalPlaneXResolution")
    written = _number(tags, "Exif:PixelXDimension")
    if focal is None or per_unit is None or written is None:
        return None
    unit = _UNIT_MM.get(int(tags.get("Exif:FocalPlaneResolutionUnit") or 2), 25.4)
    sensor_width = written / per_unit * unit
    # Software that resizes a photo updates PixelXDimension but not the resolution: the computed sensor is implausibly small.
    if not 3.0 <= sensor_width <= 60.0:
        return None
    return focal / sensor_width * max(width, height)


def camera_key(tags: Mapping[str, Any]) -> str:
    """Maker, model and focal length as one string: photos with different keys do not share intrinsics."""
    parts = [str(tags.get(name, "")).strip() for name in ("Make", "Model")]
    focal = _number(tags, "Exif:FocalLength", "Exif:FocalLengthIn35mmFilm")
    if focal is not None:
        parts.append(f"{focal:g} mm")
    return " ".join(part for part in parts if part)


def camera_body(tags: Mapping[str, Any]) -> str | None:
    """A digest of the body's serial number, which tells two of one model apart and names none; None where EXIF has no number."""
    serial = str(tags.get("Exif:BodySerialNumber", "")).strip(" \0")
    return blake3(serial.encode("utf-8", "surrogatepass")).hexdigest()[:12] if serial.strip("0") else None


def light_exposure(tags: Mapping[str, Any]) -> float | None:
    """Factor from scene luminance to the values of a photo, up to a constant of its camera: time in seconds times ISO speed over the square
    of the f-number; None where EXIF does not have all three, or has numbers of no camera."""
    time, aperture = _number(tags, "ExposureTime"), _number(tags, "FNumber")
    speed = _number(tags, "Exif:PhotographicSensitivity", "Exif:ISOSpeedRatings")
    if time is None or aperture is None or speed is None or speed >= MAX_SPEED:
        return None
    value = time * speed / aperture / aperture
    return value if 0 < value < math.inf else None


def flash_fired(tags: Mapping[str, Any]) -> bool | None:
    """Whether the camera's flash fired (bit 0 of the tag); None where EXIF does not say."""
    value = tags.get("Exif:Flash")
    return bool(int(value) & 1) if isinstance(value, int | float) and 0 <= value < 1 << 16 else None


def gps_position(tags: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Latitude and longitude in degrees and altitude in metres where a photo was taken; None where EXIF does not have all three."""
    try:
        latitude, longitude = (_degrees(tags[f"GPS:{name}"], str(tags[f"GPS:{name}Ref"])) for name in ("Latitude", "Longitude"))
        altitude = float(tags["GPS:Altitude"]) * (-1 if tags.get("GPS:AltitudeRef") == 1 else 1)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    known = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) < 1e5  # false for NaN
    return (latitude, longitude, altitude) if known else None


def _degrees(angle: Any, reference: str) -> float:
    """An angle of degrees, minutes and seconds, negative in the South and in the West."""
    degrees, minutes, seconds = (float(part) for part in angle)
    value = degrees + minutes / 60 + seconds / 3600
    return -value if reference.strip().upper()[:1] in ("S", "W") else value
