"""Base colour of metals at the full texture, finer than the photos' pixels: a linear problem once light and roughness are known.

Metal grilles, meshes and engravings have patterns of a pixel or two, bright metal beside black holes. A fit at texels of a pixel mixes both
and shows grey. What a photo shows is a straight line in the base colour, though, so with the light found each pixel says

    colour − offset = slope · mean of b over the texels that the pixel covers,

and all pixels of all photos together say more than one pixel per texel. The sum of weighted squares (errors as the eye sees them, those far
off counted less) is brought down in simultaneous steps (SIRT), which stay in [0, 1] and close to where they started where no pixel looks.

Where the metal turns out to have holes it is solved a second time, with what a grille is: bars of one metal and nothing between them. From
step to step every texel is drawn, in the end as strongly as by the pixels, to the nearer of the two. Metal without holes is left as it was
fitted: it has no such pattern, and what is solved has more noise. So is paint: what photos of paint show hangs on its diffuse shading,
which the fit at a pixel knows as well, and what reflections leave over would end as stains.

Goldlücke & Cremers, *Superresolution texture maps for multiview reconstruction*, ICCV 2009 (a texture finer than the photos, each pixel the
mean of what it covers); Gilbert, *Iterative methods for the three-dimensional reconstruction of an object from projections*, 1972 (SIRT).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from gsbake.capture.cameras import Camera
from gsbake.texture.coarse import Coarse
from gsbake.texture.fit import MaterialFit
from gsbake.texture.metal import DARKEST_METAL, ROBUST, Evidence, Line, told
from gsbake.texture.pixels import PixelReader, Pixels
from gsbake.texture.surface import Surface
from gsbake.texture.texels import Texels

Floats = NDArray[np.float32]

#: Steps of the solver, and how many of them go by before pixels far off count less.
STEPS, PLAIN = 15, 5
#: Pull towards the start, as a share of what the median texel is asked by the pixels.
STAY = 0.001
#: A place is metal where about so many texels around it are, by this share: what the pattern of a grille leaves out belongs to it.
PATTERN, SHARE = 2.0, 0.35
#: Hue is averaged over about so many texels: patterns are of bright and dark, and one lamp's reflection a little off is of one colour.
HUE = 4.0
#: What was solved counts where holes are between these shares of the texels around, about so many: metal without holes, and what is nothing
#: but a hole, were fitted as well and have less noise.
HOLES, AROUND = (0.1, 0.6), 12.0
#: Steps before a grille's texels are drawn to metal or hole. Which of the two: hole where darker than this share of the metal, whose colour
#: is the mean of the brighter texels around weighed by this power of their brightness (photos blur bars as well).
UNDRAWN, NEARER, BRIGHTER = 3, 0.4, 8
#: Reflectance of what is no metal, seen head-on.
GLOSS = 0.04


@dataclass(frozen=True)
class Seen:
    """m pixels of one photo: the texels (m, k) each is an average of and which of them `counts` (m, k), their `evidence`, and what they
    show as a `line` in a metal's base colour."""

    texel: NDArray[np.int64]
    counts: NDArray[np.bool_]
    evidence: Evidence
    line: Line


def metal_places(texels: Texels, metal: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where (n,) the texels around are mostly `metal` (n,)."""
    return np.asarray(_around(texels, metal[:, None], PATTERN)[:, 0] > SHARE)


def sharpened(values: Floats, texels: Texels, place: NDArray[np.bool_], photos: Sequence[Seen]) -> Floats:
    """`values` (n, 5) of `texels` (linear base colour, roughness, metallic) with the base colour of metals that have holes solved in
    `place` (n,).

    What turns out darker than any metal is paint in a metal's pattern: a hole. The rest of the pattern is metal alone.
    """
    base = _of_calm_hue(_solved(_parts(photos, place), values[place, :3]), texels, place)
    grille = place.copy()
    grille[place] = _patterned(texels, place, base.mean(1) < DARKEST_METAL)
    if not grille.any():
        return values

    def bars_or_holes(base: Floats) -> Floats:
        return _nearer(base, texels, grille)

    base = _of_calm_hue(_solved(_parts(photos, grille), values[grille, :3], bars_or_holes), texels, grille)
    hole = base.mean(1) < DARKEST_METAL
    out = values.copy()
    out[grille, :3] = np.where(hole[:, None], np.maximum(base - GLOSS, 0), base)
    out[grille, 4] = ~hole
    return out


def _around(texels: Texels, values: NDArray[Any], width: float) -> Floats:
    """`values` (n, c) averaged over about `width` texels around each; those outside the charts count as 0."""
    image = cv2.GaussianBlur(texels.image(values), (0, 0), width)
    return np.asarray(image.reshape(texels.size**2, -1)[texels.index])


def _patterned(texels: Texels, place: NDArray[np.bool_], hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the t texels in `place` (n,) have bright metal and holes (t,) around them, both."""
    both = np.zeros((len(place), 2), np.float32)
    both[place, 0], both[place, 1] = hole, 1
    around = _around(texels, both, AROUND)[place]
    share = around[:, 0] / np.maximum(around[:, 1], 1e-6)
    return np.asarray((share > HOLES[0]) & (share < HOLES[1]))


def _of_calm_hue(base: Floats, texels: Texels, place: NDArray[np.bool_]) -> Floats:
    """`base` (t, 3) of the `texels` in `place` (n,), each as bright as it is, but of the mean hue of those around."""
    image = np.zeros((len(place), 3), np.float32)
    image[place] = base
    around = _around(texels, image, HUE)[place]
    return np.asarray(np.clip(around * (base.mean(1) / np.maximum(around.mean(1), 1e-6))[:, None], 0, 1))


def _nearer(base: Floats, texels: Texels, place: NDArray[np.bool_]) -> Floats:
    """For each texel of `base` (t, 3) in `place` (n,) the colour (t, 3) of the metal around it, or black where that is nearer."""

    def mean(of: NDArray[Any]) -> Floats:
        weighed = np.zeros((len(place), 4), np.float32)
        weighed[place, :3], weighed[place, 3] = base * of[:, None], of
        around = _around(texels, weighed, AROUND)[place]
        return np.asarray(around[:, :3] / np.maximum(around[:, 3:], 1e-6))

    brightness = base.mean(1)
    ratio = brightness / np.maximum(mean(np.ones(len(base))).mean(1), 1e-6)
    metal = mean((ratio > 1) * ratio**BRIGHTER)
    return np.asarray(np.where((brightness > NEARER * metal.mean(1))[:, None], metal, 0), np.float32)


@dataclass(frozen=True)
class _Part:
    """One photo's share of the problem: the matrix (m, t) that averages t texels for its m pixels, their linear `colour` (m, 3), `weight`
    (m, 3) and `line`."""

    mean: Any
    colour: Floats
    weight: Floats
    line: Line

    def asks(self, base: Floats, robust: bool) -> tuple[Floats, Floats]:
        """How far each texel (t, 3) is asked to go from `base` (t, 3), and with what weight."""
        shown = np.asarray(self.mean @ base)
        use = self.weight
        if robust:
            use = np.asarray(use / np.maximum(np.abs(self.line.error(self.colour, shown)) / ROBUST, 1), np.float32)
        rest = self.colour - self.line.offset - self.line.slope * shown
        return self.mean.T @ (use * self.line.slope * rest), self.mean.T @ (use * self.line.slope**2)


def _parts(photos: Sequence[Seen], place: NDArray[np.bool_]) -> list[_Part]:
    """The photos' shares of the problem for the texels in `place` (n,): pixels most of which lie there."""
    column = np.cumsum(place) - 1
    parts: list[_Part] = []
    for seen in photos:
        counts = seen.counts & place[seen.texel]
        enough = 2 * counts.sum(1) > counts.shape[1]
        row, k = np.nonzero(counts[enough])
        share = (1 / counts.sum(1)[enough][row]).astype(np.float32)
        mean = scipy.sparse.csr_matrix((share, (row, column[seen.texel[enough][row, k]])), shape=(int(enough.sum()), int(place.sum())))
        e = seen.evidence
        line = Line(seen.line.slope[enough], seen.line.offset[enough])
        parts.append(_Part(mean, e.colour[enough], told(e)[enough], line))
    return parts


def _solved(parts: Sequence[_Part], start: Floats, likely: Callable[[Floats], Floats] | None = None) -> Floats:
    """Base colours (t, 3) in [0, 1] near `start` under which pixels show what their photos do; drawn more and more to what is `likely`,
    given the present ones, where that is said."""
    base = start.copy()
    for step in range(STEPS):
        pull, asked = np.zeros_like(start), np.zeros_like(start)
        for part in parts:
            towards, weight = part.asks(base, step >= PLAIN)
            pull += towards
            asked += weight
        usual = np.median(asked[asked > 0]) if (asked > 0).any() else 1.0
        pull, asked = pull + STAY * usual * (start - base), asked + STAY * usual
        if likely is not None and step >= UNDRAWN:
            drawn = usual * (step + 1 - UNDRAWN) / (STEPS - UNDRAWN)
            pull, asked = pull + drawn * (likely(base) - base), asked + drawn
        base = np.asarray(np.clip(base + pull / asked, 0, 1), np.float32)
    return base


def sharp_metals(
    surface: Surface,
    coarse: Coarse,
    fit: MaterialFit,
    metal: NDArray[np.bool_],
    roughness: Floats,
    values: Floats,
    photos: Sequence[tuple[Pixels, Camera]],
) -> Floats:
    """`values` (n, 5) of the surface's texels with the base colour solved anew where the `fit` found metal and the metal has holes.

    `metal` (m,) and `roughness` (m,) belong to the `coarse` texels; `photos` are the pixels they are fitted to, with cameras.
    """
    place = metal_places(coarse.texels, metal)
    reader = PixelReader(surface.whole, surface.atlas.uv, surface.texels, surface.diagonal)
    seen = []
    for pixels, camera in photos:
        rows, evidence = fit.showing(pixels, place)
        seen.append(Seen(*reader.samples(camera, pixels.pixel[rows]), evidence, Line.of(evidence, roughness, 1.0)))
    return sharpened(values, surface.texels, coarse.up(place[:, None].astype(np.float32))[:, 0] > 0.5, seen)
