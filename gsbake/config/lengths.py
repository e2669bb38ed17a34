"""Lengths and known distances as people write them: `8cm`, and `A.jpg:120,80 B.jpg:640,410 8cm`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

#: Metres per unit; a length without a unit is in metres.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "": 1.0}
#: Lengths in metres that an object or a marker can have.
MIN_METRES, MAX_METRES = 1e-5, 1e4
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)")
_NUMBER = r"-?\d+(?:\.\d+)?"
_VIEW = rf"[^:+]+:{_NUMBER},{_NUMBER}"
_DISTANCE = re.compile(rf"\s*({_VIEW}(?:\+{_VIEW})*)\s+({_VIEW}(?:\+{_VIEW})*)\s+(\S.*?)\s*")


@dataclass(frozen=True)
class PixelPosition:
    """A pixel position in a photo: the name of its file, and x, y from the top left corner, as an image viewer shows the file."""

    photo: str
    x: float
    y: float


@dataclass(frozen=True)
class KnownDistance:
    """A distance in metres between two points, each seen in one or more photos."""

    first: tuple[PixelPosition, ...]
    second: tuple[PixelPosition, ...]
    metres: float
    text: str


def parse_length(text: str) -> float:
    """Metres of a length such as `8cm`, `3.5 in` or `0.08`. Raises ValueError for anything else."""
    found = _LENGTH.fullmatch(text.strip())
    if found is None or found[2] not in UNITS:
        raise ValueError(f"'{text}' is no length; write a number and a unit (m, cm, mm, in), as in 8cm")
    metres = float(found[1]) * UNITS[found[2]]
    if not (math.isfinite(metres) and MIN_METRES <= metres <= MAX_METRES):
        raise ValueError(f"'{text}' is no plausible length; lengths are from 0.01 mm to 10 km")
    return metres


def parse_known_distance(text: str) -> KnownDistance:
    """The known distance that `text` names. Raises ValueError when it names none."""
    found = _DISTANCE.fullmatch(text)
    if found is None:
        raise ValueError(
            f"'{text}' is no known distance; write two points and the length between them, as in 'A.jpg:120,80 B.jpg:640,410 8cm', a point "
            "that is not on the object in two photos or more, as in 'A.jpg:120,80+C.jpg:131,77'"
        )
    return KnownDistance(_views(found[1]), _views(found[2]), parse_length(found[3]), text.strip())


def _views(text: str) -> tuple[PixelPosition, ...]:
    positions = []
    for view in text.split("+"):
        photo, _, pixel = view.rpartition(":")
        x, y = pixel.split(",")
        positions.append(PixelPosition(photo.strip(), float(x), float(y)))
    return tuple(positions)
