"""Is it metal? Texel by texel, both answers are tried against all photos with the light at hand.

Between paint and metal lies a hill that gradient steps do not climb: paint that is slowly turned to metal loses its own colour before
it gains a reflection. Seen through one light, though, either answer is linear in the base colour b,

    paint: shade = b · E(n) + L(d) · (.04 A + B)        metal: shade = b · L(d) A + L(d) B

(METHOD §6), so for each of a few roughnesses the best b follows from sums over the texel's pixels, weighed by the slope of the sRGB curve
at the photo's own colour: errors are those of the eye, not of the lamp. What that b leaves unexplained is then measured as a photo would
show it, clipped at white and robust: a lamp in a mirror is no brighter than white paper, and where the reflection is a little off one
pixel must not outweigh the others. A metal must reflect clearly more of every colour than the .04 of paint, or black gloss passes for
a dark metal. A texel has seen too few pixels to tell by itself: neighbours that look alike decide together (`alike`), each with its own
colour, and what most of them are all of them are. Clean metals reflect a third or more (gold's blue is .34: Lagarde & de Rousiers,
*Moving Frostbite to PBR*, 2014), but rusty, anodised and dirty ones, and many that artists painted, go down to .1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode

Floats = NDArray[np.float64]

#: Roughnesses tried beside a texel's own.
ROUGHNESS = (0.1, 0.2, 0.35, 0.55)
#: Least base colour of a metal, and of a clean one (its mean).
DARKEST_METAL, CLEAN_METAL = 0.1, 0.3
#: What the metal leaves unexplained must be below this share of what the paint leaves: for dark metals, which are rarer, and clean ones.
CLEARLY = (0.9, 1.0)
#: So much of what looks alike around a texel must be metal, or the texel is paint as well; and the other way round: a place that one lamp's
#: misplaced reflection spoils goes with its surroundings.
MOST = 0.5
#: Pixels brighter than this (linear) do not say how much is reflected; errors of sRGB values beyond about the second count by themselves.
WHITE, ROBUST = 0.95, 0.1
#: Darkest linear colour that the slope of the sRGB curve is taken at.
DIM = 0.02
#: Texels with less weight of pixels than this are left alone, and those that fewer photos saw, or this share of what is around them: seen
#: from few sides, paint under a light that is not quite right yet passes for metal.
LEAST_WEIGHT, LEAST_PHOTOS, NEARBY = 0.3, 6, 0.05

#: Shades pixels of one photo: (base colour 0 or 1, roughness (texels,), metallic 0 or 1) to linear colours (n, 3).
Shader = Callable[[float, NDArray[np.float32], float], NDArray[np.float32]]


@dataclass(frozen=True)
class Evidence:
    """n pixels of one photo: the `texel` (n,) each shows, its linear `colour` (n, 3), `weight` (n,), the `block` (n,) of
    the photo it lies in, and how to `shade` them."""

    texel: NDArray[np.int64]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    block: NDArray[np.int32]
    shade: Shader


def by_eye(evidence: Evidence) -> NDArray[np.float32]:
    """Weights (n, 3) of squared errors of linear colours: the pixels' own times the squared slope of the sRGB curve (a power of 1/2.4)."""
    return np.asarray(evidence.weight[:, None] * np.maximum(evidence.colour, DIM) ** (-7 / 6), np.float32)


def told(evidence: Evidence) -> NDArray[np.float32]:
    """`by_eye` of what is not clipped at white."""
    return by_eye(evidence) * (evidence.colour < WHITE)


def seen(photos: Sequence[Evidence], texels: int) -> Floats:
    """Weight (texels,) of all pixels that show each texel."""
    out = np.zeros(texels)
    for photo in photos:
        out += np.bincount(photo.texel, photo.weight, texels)
    return out


@dataclass(frozen=True)
class Metals:
    """Texels (m,) that metal explains better than paint, with the metal's linear base colour (m, 3) and roughness (m,)."""

    texel: NDArray[np.int64]
    base: Floats
    roughness: Floats


@dataclass(frozen=True)
class Line:
    """A photo's pixels as lines in the base colour: shade = b · `slope` + `offset`, both (n, 3)."""

    slope: NDArray[np.float32]
    offset: NDArray[np.float32]

    @classmethod
    def of(cls, evidence: Evidence, roughness: NDArray[np.float32], metallic: float) -> Line:
        """The lines of all pixels of `evidence` at the `roughness` (texels,) and this `metallic`."""
        offset = evidence.shade(0.0, roughness, metallic)
        return cls(evidence.shade(1.0, roughness, metallic) - offset, offset)

    def error(self, colour: NDArray[np.float32], base: NDArray[Any]) -> NDArray[np.float32]:
        """Errors (n, 3) of sRGB values, clipped at white, of pixels of linear `colour` (n, 3) that show `base` (n, 3)."""
        return np.asarray(encode(np.clip(base * self.slope + self.offset, 0, 1)) - encode(colour))

    def unexplained(self, evidence: Evidence, base: Floats) -> Floats:
        """Weighted robust errors (texels,) with `base` (texels, 3)."""
        error = self.error(evidence.colour, base[evidence.texel])
        robust = (np.sqrt(error**2 + ROBUST**2) - ROBUST).sum(1)
        return np.asarray(np.bincount(evidence.texel, evidence.weight * robust, len(base)), np.float64)


class _Sums:
    """What the pixels of each texel say about b in shade = b · slope + offset, least squares."""

    def __init__(self, texels: int) -> None:
        self.slopes, self.mixed = np.zeros((texels, 3)), np.zeros((texels, 3))

    def add(self, evidence: Evidence, weight: NDArray[Any], line: Line) -> None:
        rest = evidence.colour - line.offset
        for k in range(3):
            w, a, d = weight[:, k], line.slope[:, k], rest[:, k]
            for total, value in ((self.slopes, w * a * a), (self.mixed, w * a * d)):
                total[:, k] += np.bincount(evidence.texel, value, len(total))

    def best(self, darkest: float) -> Floats:
        """b (texels, 3) within [darkest, 1]."""
        return np.clip(self.mixed / np.maximum(self.slopes, 1e-12), darkest, 1.0)


def as_around(better: NDArray[np.bool_], known: NDArray[np.bool_], around: Callable[[Floats], Floats]) -> NDArray[np.bool_]:
    """Which of the texels that are `known` (n,) are metal if each is what most known ones `around` it are, by `better` (n,)."""
    return np.asarray(known & (around((better & known).astype(np.float64)) > MOST * around(known.astype(np.float64))))


def find_metals(photos: Sequence[Evidence], own: NDArray[np.float32], around: Callable[[Floats], Floats] = lambda left: left) -> Metals:
    """The texels that are better explained as metal; `own` (texels,) is their present roughness.

    `around` averages what is left unexplained (texels,) over the neighbours that decide together: a texel by itself has seen too little.
    """
    texels = len(own)
    weights = [told(e) for e in photos]
    paint, metal = np.full(texels, np.inf), np.full(texels, np.inf)
    base, roughness = np.zeros((texels, 3)), np.zeros(texels)
    for tried in (own, *(np.full(texels, r, np.float32) for r in ROUGHNESS)):
        for metallic, darkest in ((0.0, 0.0), (1.0, DARKEST_METAL)):
            lines = [Line.of(evidence, tried, metallic) for evidence in photos]
            sums = _Sums(texels)
            for evidence, weight, line in zip(photos, weights, lines, strict=True):
                sums.add(evidence, weight, line)
            b = sums.best(darkest)
            left = sum((line.unexplained(evidence, b) for evidence, line in zip(photos, lines, strict=True)), np.zeros(texels))
            if not metallic:
                paint = np.minimum(paint, left)
                continue
            better = left < metal
            metal[better], base[better], roughness[better] = left[better], b[better], tried[better]
    sides = sum((around((np.bincount(e.texel, e.weight, texels) > 0).astype(np.float64)) > NEARBY for e in photos), np.zeros(texels, int))
    known = (seen(photos, texels) > LEAST_WEIGHT) & (sides >= LEAST_PHOTOS)
    count = np.maximum(around(known.astype(np.float64)), 1e-9)
    share = np.where(around(np.where(known, base.mean(1), 0.0)) / count < CLEAN_METAL, *CLEARLY)
    better = np.asarray(around(metal) < share * around(paint))
    chosen = np.flatnonzero(as_around(better, known, around))
    return Metals(chosen, base[chosen], roughness[chosen])
