"""Patches of known reflectance as people write them: `A.jpg:120,80` for white paper, `A.jpg:120,80:0.18` for a grey card."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gsbake.config.lengths import PixelPosition

#: Reflectance of white paper.
PAPER = 0.9
#: Reflectances that a patch can have: darker ones are too noisy to tell of the light.
MIN_REFLECTANCE, MAX_REFLECTANCE = 0.02, 1.0
_NUMBER = r"\d+(?:\.\d*)?|\.\d+"
_PATCH = re.compile(rf"\s*(.*[^:\s]):({_NUMBER}),({_NUMBER})(?::({_NUMBER}))?\s*")


@dataclass(frozen=True)
class WhitePatch:
    """A patch of the object with a known `reflectance`, the same in all colours, about a pixel of a photo."""

    position: PixelPosition
    reflectance: float
    text: str


def parse_white(text: str) -> WhitePatch:
    """The patch that `text` names. Raises ValueError when it names none."""
    found = _PATCH.fullmatch(text)
    if found is None:
        raise ValueError(
            f"'{text}' is no patch of known reflectance; write a photo, a pixel and the reflectance, as in 'A.jpg:120,80:0.18', or for "
            "white paper 'A.jpg:120,80'"
        )
    reflectance = PAPER if found[4] is None else float(found[4])
    if not MIN_REFLECTANCE <= reflectance <= MAX_REFLECTANCE:
        raise ValueError(f"the reflectance of '{text}' must be from {MIN_REFLECTANCE:g} to {MAX_REFLECTANCE:g}")
    return WhitePatch(PixelPosition(found[1], float(found[2]), float(found[3])), reflectance, text.strip())
