"""Does it glow? Regions of the texture whose light does not follow the light that falls on them.

Under one light a lamp and a bright paint look alike at any single texel. Over a region of one colour they do not: what paint sends back
follows the irradiance E as the surface turns and shadows fall, what glows is the same everywhere. Texel by texel the photos give what is
left of the light without the gloss, and the fit gives E; in every connected region of like texels log left is regressed on log E:

    paint: slope 1        glow: slope 0, and what is left hardly varies while E does.

Such a region must end at an edge: a part that glows is a part, whereas a band of like brightness on shaded paint is not.

E is smoothed first, to what changes evenly from one end of the region to the other: normals of a mesh tremble, and a trembling E would
flatten the slope of any paint. Only what paint could hardly be is asked at all: left / E near or above 1, for energy is conserved and
paints paler than snow do not exist (Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014, give .8 as the most). A flat lamp under even
light stays paint: nothing tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from gsbake.materials.metallic import LEAST_WEIGHT, Evidence, by_eye, seen

Floats = NDArray[np.float64]

#: Neighbouring texels belong together when their strongest channel differs by less than this share; dimmer ones than `DIMMEST` never do.
ALIKE, DIMMEST = 0.08, 0.08
#: Smallest region that is asked, in texels.
SMALLEST = 64
#: Base colour (strongest channel, median) from which paint is doubted.
PALEST = 0.7
#: Standard deviations of the logarithms: the irradiance must vary by `VARIES`, the region's light by `EVEN` of that at most; largest slope.
VARIES, EVEN, SLOPE = 0.025, 0.5, 0.25
#: Texels further out than this many robust standard deviations of a region take no part (print, rims).
OUTLYING = 3.0
#: The rim of a region mixes with what is beside it: so many texels around it glow by what they show, if the hue (cosine) is the same.
RIM, SAME_HUE = 2, 0.97
#: Beyond the rim, within as many texels again, most texels must differ from the region by this share of its strongest channel.
EDGE = 0.3


@dataclass(frozen=True)
class Glow:
    """Texels (m,) that glow and their linear radiance (m, 3); `regions` they form."""

    texel: NDArray[np.int64]
    radiance: Floats
    regions: int


def find_glow(photos: Sequence[Evidence], own: NDArray[np.float32], pairs: NDArray[np.int64], place: NDArray[Any]) -> Glow:
    """The texels that glow; `own` (n,) is their present roughness, `pairs` (p, 2) the neighbouring ones, `place` (n, 3) where each
    lies on the surface."""
    left, irradiance = _left(photos, own)
    peak = left.max(1)
    pairs = pairs[(seen(photos, len(own)) > LEAST_WEIGHT)[pairs].all(1)]
    first, second = pairs[(peak > DIMMEST)[pairs].all(1)].T
    apart = np.abs(left[first] - left[second]).max(1)
    like = apart < ALIKE * np.maximum(peak[first], peak[second])
    region = _components(len(own), first[like], second[like])
    chosen: list[NDArray[np.int64]] = []
    sizes = np.bincount(region)
    order = np.argsort(region, kind="stable")
    ends = np.cumsum(sizes)
    for index in np.flatnonzero(sizes >= SMALLEST):
        member = order[ends[index] - sizes[index] : ends[index]]
        core = member[_core(left[member].mean(1))]
        if _glows(left[core], irradiance[core], place[core]) and _ends(member, left, pairs):
            chosen.append(member)
    glowing = np.zeros(len(own), bool)
    for member in chosen:
        glowing[_grown(member, np.median(left[member], 0), left, pairs)] = True
    texel = np.flatnonzero(glowing)
    return Glow(texel, np.maximum(left[texel], 0), len(chosen))


def _left(photos: Sequence[Evidence], own: NDArray[np.float32]) -> tuple[Floats, Floats]:
    """Per texel, averaged over the photos: light (n, 3) without the gloss of black paint, and irradiance / π (n, 3)."""
    n = len(own)
    left, irradiance, total = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    for photo in photos:
        weight, gloss = by_eye(photo), photo.shade(0.0, own, 0.0)
        lit = photo.shade(1.0, own, 0.0) - gloss
        for sums, value in ((left, weight * (photo.colour - gloss)), (irradiance, weight * lit), (total, weight)):
            for k in range(3):
                sums[:, k] += np.bincount(photo.texel, value[:, k], n)
    whole = np.maximum(total, 1e-12)
    return left / whole, irradiance / whole


def _components(n: int, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    """Region (n,) of each of n texels when the pairs are joined."""
    graph = scipy.sparse.coo_matrix((np.ones(len(first), bool), (first, second)), shape=(n, n))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], np.int64)


def _core(brightness: Floats) -> NDArray[np.bool_]:
    """Which texels (m,) of a region are not outlying."""
    middle = np.median(brightness)
    off = np.abs(brightness - middle)
    return np.asarray(off <= OUTLYING * 1.4826 * np.median(off) + 0.01 * middle)


def _glows(left: Floats, irradiance: Floats, place: NDArray[Any]) -> bool:
    """Whether a region of m texels with light `left` (m, 3) under `irradiance` / π (m, 3) at `place` (m, 3) glows."""
    paint = np.median(left / np.maximum(irradiance, 1e-6), 0).max()
    if not paint > PALEST:
        return False
    plane = np.column_stack([np.ones(len(place)), place - place.mean(0)])
    fallen = irradiance.mean(1)
    smooth = plane @ np.linalg.lstsq(plane, fallen, rcond=None)[0]
    fallen, sent = np.log(np.maximum(smooth, 1e-6)), np.log(np.maximum(left.mean(1), 1e-6))
    fallen, sent = fallen - fallen.mean(), sent - sent.mean()
    return bool(fallen.std() > VARIES and sent.std() < EVEN * fallen.std() and (fallen @ sent) < SLOPE * (fallen @ fallen))


def _ends(member: NDArray[np.int64], left: Floats, pairs: NDArray[np.int64]) -> bool:
    """Whether the region `member` (m,) of texels with light `left` (n, 3) ends at an edge of colour rather than in a gradient."""
    middle = np.median(left[member], 0)
    inside = _spread(member, len(left), pairs, RIM)
    ring = _spread(np.flatnonzero(inside), len(left), pairs, RIM) & ~inside
    return bool(ring.any()) and bool(np.median(np.abs(left[ring] - middle).max(1)) > EDGE * middle.max())


def _spread(
    member: NDArray[np.int64], n: int, pairs: NDArray[np.int64], steps: int, through: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Mask (n,) of the texels within so many steps of `member`, going only `through` those marked."""
    inside = np.zeros(n, bool)
    inside[member] = True
    for _ in range(steps):
        beside = pairs[inside[pairs].any(1)].ravel()
        inside[beside if through is None else beside[through[beside]]] = True
    return inside


def _grown(member: NDArray[np.int64], hue: Floats, left: Floats, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """`member` and the texels of its `hue` (3,) within `RIM` steps of it."""
    length = np.maximum(np.linalg.norm(left, axis=1), 1e-12)
    same = (left @ hue) / (length * np.linalg.norm(hue)) > SAME_HUE
    return np.flatnonzero(_spread(member, len(left), pairs, RIM, same))
