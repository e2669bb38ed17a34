"""Base colour of metals at the full texture, finer than the photos' pixels: a linear problem once light and roughness are known.

Metal grilles, meshes and engravings have patterns of a pixel or two, bright metal beside black holes. A fit at texels of a pixel mixes both
and shows grey. What a photo shows is a straight line in the base colour, though, so with the light found each pixel says

    colour − offset = slope · mean of b over the texels that the pixel covers,

and all pixels of all photos together say more than one pixel per texel. The sum of weighted squares (errors as the eye sees them, those far
off counted less) is brought down in simultaneous steps (SIRT), which stay in [0, 1] and close to where they started where no pixel looks.

Holes are in the same places whichever photos they are seen in, and reflections that the light does not explain are not. So it is solved
with all photos and with either half of them, and where the first finds holes and both halves show the same pattern there is a grille. Metal
without holes is left as it was fitted: it has no such pattern, and what is solved has more noise. So is paint: what photos of paint show
hangs on its diffuse shading, which the fit at a pixel knows as well, and what reflections leave over would end as stains.

Grilles are solved once more, with what they are: bars of one metal and nothing between them. From step to step every texel is drawn, in the
end as strongly as by the pixels, to one of the two: to metal the brightest, so many as the mean brightness around says. (All that is
brighter than half of the bars would be too many: in a blurred picture of thin bars that is the holes' rims as well.) Two things are let go
meanwhile, as bars are bent and the light found is more blurred than the room: bars may be brighter than white, and what is shaded may be
off by a factor that changes slowly over a photo, which is taken from the photo anew in each step (`_Part.gain`). Then a pixel tells how
bright it is beside those around it.

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

from gsbake.geometry.cameras import Camera
from gsbake.materials.fit import MaterialFit
from gsbake.materials.metallic import DARKEST_METAL, ROBUST, Evidence, Line, told
from gsbake.materials.pixels import PixelReader, Pixels
from gsbake.texturing.resampling import Coarse
from gsbake.texturing.texels import Texels
from gsbake.texturing.unwrapped_mesh import Surface

Floats = NDArray[np.float32]

#: Steps of the solver.
STEPS = 15
#: Pull towards the start, as a share of what the median texel is asked by the pixels.
STAY = 0.001
#: A photo's gain is that of the pixels around, about so many across, within this factor; and it is 1 as far as expected colours are below
#: this share of their mean.
LOCAL, GAIN, EVEN = 4.0, 8.0, 0.003
#: A place is metal where about so many texels around it are, by this share: what the pattern of a grille leaves out belongs to it.
PATTERN, SHARE = 2.0, 0.35
#: Hue is averaged over about so many texels: patterns are of bright and dark, and one lamp's reflection a little off is of one colour.
HUE = 4.0
#: What was solved counts where holes are between these shares of the texels around, about so many: metal without holes, and what is nothing
#: but a hole, were fitted as well and have less noise. And where both halves of the photos show the pattern, by this correlation of what is
#: finer than `FINE` texels.
HOLES, AROUND, ALIKE, FINE = (0.1, 0.6), 12.0, 0.25, 3.0
#: Steps before a grille's texels are drawn to metal or hole, and how bright metal may become until then. Its colour is the mean of the
#: brighter texels around weighed by this power of their brightness (photos blur bars as well).
UNDRAWN, BRIGHTEST, BRIGHTER = 3, 1.5, 4
#: Shares of the metal's brightness tried as the least of a bar, and the one below which what was drawn is a hole.
LEAST, HOLE = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), 0.25
#: Reflectance of what is no metal, seen head-on.
GLOSS = 0.04


@dataclass(frozen=True)
class Seen:
    """m pixels of one photo: their `column` (m,) and `row` (m,), the texels (m, k) each is an average of and which of them `counts` (m, k),
    their `evidence`, and what they show as a `line` in a metal's base colour."""

    column: NDArray[np.int64]
    row: NDArray[np.int64]
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

    What turns out darker than any metal, or much darker than the metal around, is a hole: paint, and rough, as nothing is there that would
    mirror the room. The rest of the grille is metal alone.
    """
    parts, start = _parts(photos, place), values[place, :3]
    whole, one, other = (_of_calm_hue(_solved(some, start), texels, place).mean(1) for some in (parts, parts[::2], parts[1::2]))
    grille = place.copy()
    grille[place] = _patterned(texels, place, whole < DARKEST_METAL) & _repeated(texels, place, one, other)
    if not grille.any():
        return values

    def bars_or_holes(base: Floats) -> Floats:
        return _likely(base, texels, grille)

    base = _of_calm_hue(_solved(_parts(photos, grille), values[grille, :3], bars_or_holes), texels, grille)
    metal = _metal(base, texels, grille).mean(1)
    hole = base.mean(1) < np.maximum(HOLE * metal, DARKEST_METAL)
    out = values.copy()
    out[grille, :3] = np.where(hole[:, None], np.maximum(base - GLOSS, 0), np.minimum(base, 1))
    if np.ptp(values[:, 3]) > 0:  # else one number does all over
        out[grille, 3] = np.where(hole, 1, out[grille, 3])
    out[grille, 4] = ~hole
    return out


def _around(texels: Texels, values: NDArray[Any], width: float) -> Floats:
    """`values` (n, c) averaged over about `width` texels around each; those outside the charts count as 0."""
    image = cv2.GaussianBlur(texels.image(values), (0, 0), width)
    return np.asarray(image.reshape(texels.size**2, -1)[texels.index])


def _patterned(texels: Texels, place: NDArray[np.bool_], hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the t texels in `place` (n,) have bright metal and holes (t,) around them, both."""
    share = _mean(hole[:, None], texels, place, AROUND)[:, 0]
    return np.asarray((share > HOLES[0]) & (share < HOLES[1]))


def _repeated(texels: Texels, place: NDArray[np.bool_], one: Floats, other: Floats) -> NDArray[np.bool_]:
    """Where (t,) in `place` (n,) two brightnesses `one`, `other` (t,) have the same fine pattern around."""
    both = np.stack([one, other], 1)
    a, b = (both - _mean(both, texels, place, FINE)).T
    shared, first, second = _mean(np.stack([a * b, a * a, b * b], 1), texels, place, AROUND).T
    return np.asarray(shared > ALIKE * np.sqrt(first * second))


def _mean(values: NDArray[Any], texels: Texels, place: NDArray[np.bool_], width: float, of: NDArray[Any] | None = None) -> Floats:
    """`values` (t, c) of the `texels` in `place` (n,) averaged over about `width` texels around each, weighed by `of` (t,)."""
    weight = np.ones(len(values), np.float32) if of is None else of
    weighed = np.zeros((len(place), values.shape[1] + 1), np.float32)
    weighed[place, :-1], weighed[place, -1] = values * weight[:, None], weight
    around = _around(texels, weighed, width)[place]
    return np.asarray(around[:, :-1] / np.maximum(around[:, -1:], 1e-6))


def _of_calm_hue(base: Floats, texels: Texels, place: NDArray[np.bool_]) -> Floats:
    """`base` (t, 3) of the `texels` in `place` (n,), each as bright as it is, but of the mean hue of those around."""
    around = _mean(base, texels, place, HUE)
    return np.asarray(around * (base.mean(1) / np.maximum(around.mean(1), 1e-6))[:, None])


def _metal(base: Floats, texels: Texels, place: NDArray[np.bool_]) -> Floats:
    """The colour (t, 3) of the metal around each texel of `base` (t, 3) in `place` (n,): that of the brighter ones."""
    brightness = base.mean(1)
    ratio = brightness / np.maximum(_mean(base, texels, place, AROUND).mean(1), 1e-6)
    return _mean(base, texels, place, AROUND, (ratio > 1) * ratio**BRIGHTER)


def _likely(base: Floats, texels: Texels, place: NDArray[np.bool_]) -> Floats:
    """For each texel of `base` (t, 3) in `place` (n,) the colour (t, 3) of the metal around it, or black.

    The brightest are metal: where that is everything above the first of `LEAST` shares of the metal, or the next …, bars of that metal are
    more or less bright in the mean, and between them lies the share with which they are as bright as `base` is there.
    """
    metal = _metal(base, texels, place)
    share = base.mean(1) / np.maximum(metal.mean(1), 1e-6)
    above = _mean(np.column_stack([share[:, None] > np.asarray(LEAST), share]), texels, place, FINE)
    wanted = above[:, -1]
    least = np.full(len(base), LEAST[0])
    for k in range(1, len(LEAST)):
        more, fewer = above[:, k - 1], above[:, k]
        part = np.clip((more - wanted) / np.maximum(more - fewer, 1e-6), 0, 1)
        least = np.where(more > wanted, LEAST[k - 1] + part * (LEAST[k] - LEAST[k - 1]), least)
    return np.where((share > least)[:, None], metal, np.float32(0))


@dataclass(frozen=True)
class _Part:
    """One photo's share of the problem: the matrix (m, t) that averages t texels for its m pixels, their `column` and `row` (m,), linear
    `colour` (m, 3), `weight` (m, 3) and `line`."""

    mean: Any
    column: NDArray[np.int64]
    row: NDArray[np.int64]
    colour: Floats
    weight: Floats
    line: Line

    def gain(self, shown: Floats, before: Floats) -> Floats:
        """How much brighter (m, 1) than shaded the photo is around each pixel that shows the base colour `shown` (m, 3); it was taken to be
        `before`."""
        weight = self._trusted(shown, self._gained(before))
        shaded = self.line.slope * shown + self.line.offset
        sums = np.stack([(weight * shaded * self.colour).sum(1), (weight * shaded**2).sum(1)], 1)
        column, row = self.column - self.column.min(), self.row - self.row.min()
        image = np.zeros((row.max() + 1, column.max() + 1, 2), np.float32)
        image[row, column] = sums
        around, expected = cv2.GaussianBlur(image, (0, 0), LOCAL)[row, column].T
        even = EVEN * expected.mean()
        return np.asarray(np.clip((around + even) / np.maximum(expected + even, 1e-12), 1 / GAIN, GAIN)[:, None], np.float32)

    def asks(self, shown: Floats, gain: Floats) -> tuple[Floats, Floats]:
        """How far each texel (t, 3) is asked to go where the pixels show `shown` (m, 3) with this `gain` (m, 1), and with what weight."""
        line = self._gained(gain)
        use = self._trusted(shown, line)
        rest = self.colour - line.offset - line.slope * shown
        return self.mean.T @ (use * line.slope * rest), self.mean.T @ (use * line.slope**2)

    def _gained(self, gain: Floats) -> Line:
        """The line of a photo that is brighter by `gain` (m, 1)."""
        return Line(gain * self.line.slope, gain * self.line.offset)

    def _trusted(self, shown: Floats, line: Line) -> Floats:
        """The weights (m, 3), those of pixels far from what `line` says of `shown` (m, 3) less."""
        return np.asarray(self.weight / np.maximum(np.abs(line.error(self.colour, shown)) / ROBUST, 1), np.float32)


def _parts(photos: Sequence[Seen], place: NDArray[np.bool_]) -> list[_Part]:
    """The photos' shares of the problem for the texels in `place` (n,): pixels most of which lie there."""
    column = np.cumsum(place) - 1
    parts: list[_Part] = []
    for seen in photos:
        counts = seen.counts & place[seen.texel]
        enough = 2 * counts.sum(1) > counts.shape[1]
        if not enough.any():
            continue
        row, k = np.nonzero(counts[enough])
        share = (1 / counts.sum(1)[enough][row]).astype(np.float32)
        mean = scipy.sparse.csr_matrix((share, (row, column[seen.texel[enough][row, k]])), shape=(int(enough.sum()), int(place.sum())))
        e = seen.evidence
        line = Line(seen.line.slope[enough], seen.line.offset[enough])
        parts.append(_Part(mean, seen.column[enough], seen.row[enough], e.colour[enough], told(e)[enough], line))
    return parts


def _solved(parts: Sequence[_Part], start: Floats, likely: Callable[[Floats], Floats] | None = None) -> Floats:
    """Base colours (t, 3) in [0, 1] near `start` under which pixels show what their photos do.

    With `likely` they are drawn more and more to what it says of the present ones, up to `BRIGHTEST`, and photos have gains.
    """
    base = start.copy()
    gains = [np.ones((len(part.row), 1), np.float32) for part in parts]
    for step in range(STEPS):
        pull, asked = np.zeros_like(start), np.zeros_like(start)
        for k, part in enumerate(parts):
            shown = np.asarray(part.mean @ base)
            if likely is not None:
                gains[k] = part.gain(shown, gains[k])
            towards, weight = part.asks(shown, gains[k])
            pull += towards
            asked += weight
        usual = np.median(asked[asked > 0]) if (asked > 0).any() else 1.0
        pull, asked = pull + STAY * usual * (start - base), asked + STAY * usual
        if likely is not None and step >= UNDRAWN:
            drawn = usual * (step + 1 - UNDRAWN) / (STEPS - UNDRAWN)
            pull, asked = pull + drawn * (likely(base) - base), asked + drawn
        base = np.asarray(np.clip(base + pull / asked, 0, 1 if likely is None else BRIGHTEST), np.float32)
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
        pixel = pixels.pixel[rows]
        row, column = np.divmod(pixel, camera.width)
        seen.append(Seen(column, row, *reader.samples(camera, pixel), evidence, Line.of(evidence, roughness, 1.0)))
    return sharpened(values, surface.texels, coarse.up(place[:, None].astype(np.float32))[:, 0] > 0.5, seen)
