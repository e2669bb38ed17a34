"""Known reflectances as people write them: `A.jpg:120,80` for white paper on the object, `A.jpg:120,80:0.18` for a grey card on it;
`markers` and `card` for the paper of printed markers and a colour card that lie beside it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from gsbake.config.lengths import PixelPosition

#: Reflectance of white paper.
PAPER = 0.9
#: Reflectances that a patch can have: darker ones are too noisy to tell of the light.
MIN_REFLECTANCE, MAX_REFLECTANCE = 0.02, 1.0
_NUMBER = r"\d+(?:\.\d*)?|\.\d+"
_MARKERS = re.compile(rf"\s*markers(?::({_NUMBER}))?\s*")
_PATCH = re.compile(rf"\s*(.*[^:\s]):({_NUMBER}),({_NUMBER})(?::({_NUMBER}))?\s*")


@dataclass(frozen=True)
class WhitePatch:
    """A patch of the object with a known `reflectance`, the same in all colours, about a pixel of a photo."""

    position: PixelPosition
    reflectance: float
    text: str


@dataclass(frozen=True)
class PrintedWhite:
    """Printed markers, whose paper has a known `reflectance`, or a colour card, whose grey patches have those of its maker (None)."""

    kind: Literal["markers", "card"]
    reflectance: float | None
    text: str


def parse_white(text: str) -> WhitePatch | PrintedWhite:
    """The patch that `text` names. Raises ValueError when it names none."""
    if text.strip() == "card":
        return PrintedWhite("card", None, "card")
    if printed := _MARKERS.fullmatch(text):
        return PrintedWhite("markers", _reflectance(printed[1], text), text.strip())
    found = _PATCH.fullmatch(text)
    if found is None:
        raise ValueError(
            f"'{text}' is no patch of known reflectance; write a photo, a pixel and the reflectance, as in 'A.jpg:120,80:0.18', or for "
            "white paper 'A.jpg:120,80'; or markers, or card"
        )
    return WhitePatch(PixelPosition(found[1], float(found[2]), float(found[3])), _reflectance(found[4], text), text.strip())


def _reflectance(number: str | None, text: str) -> float:
    reflectance = PAPER if number is None else float(number)
    if not MIN_REFLECTANCE <= reflectance <= MAX_REFLECTANCE:
        raise ValueError(f"the reflectance of '{text}' must be from {MIN_REFLECTANCE:g} to {MAX_REFLECTANCE:g}")
    return reflectance
