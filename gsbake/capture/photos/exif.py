"""Focal length in pixels from EXIF (CIPA DC-008, "Exif 2.32").

Only a first guess that structure from motion refines: photos get cropped and resized after they were taken, and EXIF does not follow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

#: Diagonal of the 36 x 24 mm frame that the 35 mm equivalent refers to (CIPA DCG-001).
FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)
#: Aspect ratios whole sensors have; any other one says that the photo was cropped.
SENSOR_ASPECTS = (4 / 3, 3 / 2, 16 / 9)
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def _number(tags: Mapping[str, Any], *names: str) -> float | None:
    for name in names:
        value = tags.get(name)
        if isinstance(value, int | float) and math.isfinite(value) and value > 0:
            return float(value)
    return None


def is_cropped(width: int, height: int) -> bool:
    """Whether a photo's aspect ratio is none that a whole sensor has (within 1 %)."""
    aspect = max(width, height) / min(width, height)
    return all(abs(aspect / known - 1) > 0.01 for known in SENSOR_ASPECTS)


def focal_pixels(tags: Mapping[str, Any], width: int, height: int) -> float | None:
    """Focal length in pixels of a photo of width x height, or None where EXIF does not tell.

    `tags` are OpenImageIO's attribute names. The 35 mm equivalent is taken before the sensor size computed from the focal plane
    resolution, which refers to the pixels the camera wrote (`PixelXDimension` tells how much the photo was reduced since).
    A photo whose aspect ratio no sensor has was cropped, so that nothing can be said.
    """
    if is_cropped(width, height):
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
    # Software that resizes a photo updates PixelXDimension but not the resolution: the "sensor" comes out smaller than any real one.
    if not 3.0 <= sensor_width <= 60.0:
        return None
    return focal / sensor_width * max(width, height)


def camera_key(tags: Mapping[str, Any]) -> str:
    """Maker, model and focal length as one text: photos that differ in it were not taken by one camera at one zoom."""
    parts = [str(tags.get(name, "")).strip() for name in ("Make", "Model")]
    focal = _number(tags, "Exif:FocalLength", "Exif:FocalLengthIn35mmFilm")
    if focal is not None:
        parts.append(f"{focal:g} mm")
    return " ".join(part for part in parts if part)
