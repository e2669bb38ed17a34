"""Metal detection: a dielectric and a metallic model of every texel compared on all photos under the present light.

Gradient steps do not turn a dielectric into a metal: on the way it loses its diffuse colour before it gains a reflection. Under a known
environment, though, both models are linear in the base colour b,

    dielectric: shade = b · E(n) + L(d) · (.04 A + B)        metal: shade = b · L(d) A + L(d) B

so for each of a few roughnesses the best b is a weighted least-squares solution over the texel's pixels; weights contain the squared slope
of the sRGB curve, so that errors count as they are displayed. The residual with that b is clipped at white and robust: displays are no
brighter than white, and one misplaced reflection must not outweigh the other pixels. A metal must reflect clearly more of every channel
than the 4 % of dielectrics, else glossy black would pass for a dark metal. A texel has too few pixels to decide by itself: residuals are
averaged over neighbours of similar colour (`bilateral`), and isolated texels follow the majority around them. Clean metals reflect a third
or more (gold's blue is .34: Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014), rusty, anodised and dirty ones go down to .1.
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
TRIED_ROUGHNESS = (0.1, 0.2, 0.35, 0.55)
#: Roughest metal: rougher ones shade like dielectrics, and oxides, which are rough, are dielectrics.
MAX_METAL_ROUGHNESS = 0.6
#: Lowest linear base colour of a metal, and lowest mean base colour of a clean one.
MIN_METAL_ALBEDO, CLEAN_METAL_ALBEDO = 0.1, 0.3
#: The metal's residual must be below this share of the dielectric's: for dark metals, which are rarer, and for clean ones.
MAX_RESIDUAL_RATIO = (0.9, 1.0)
#: Share of metal among similar neighbours above which a texel is metal: removes isolated texels and fills isolated gaps.
MAJORITY = 0.5
#: Linear values above the first are taken as clipped; sRGB residuals beyond the second count linearly.
CLIPPED, ROBUST_SCALE = 0.95, 0.1
#: Lowest linear colour at which the slope of the sRGB curve is taken.
MIN_SLOPE_COLOUR = 0.02
#: Texels with less weight of pixels than the first are undecided, as are those visible in fewer photos than the second: from few directions
#: a dielectric under a slightly wrong light passes for metal. A photo counts for a texel from the third share of pixels around it.
MIN_WEIGHT, MIN_PHOTOS, MIN_PHOTO_SHARE = 0.3, 6, 0.05

#: Shades pixels of one photo: (base colour 0 or 1, roughness (texels,), metallic 0 or 1) to linear colours (n, 3).
Shader = Callable[[float, NDArray[np.float32], float], NDArray[np.float32]]


@dataclass(frozen=True)
class PhotoSamples:
    """n pixels of one photo: the `texel` (n,) each shows, its linear `colour` (n, 3), `weight` (n,), the `block` (n,) of
    the photo it lies in, and the function that shades them."""

    texel: NDArray[np.int64]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    block: NDArray[np.int32]
    shade: Shader


def perceptual_weights(samples: PhotoSamples) -> NDArray[np.float32]:
    """Weights (n, 3) of squared errors of linear colours: pixel weight times squared slope of the sRGB curve (a power of 1/2.4)."""
    return np.asarray(samples.weight[:, None] * np.maximum(samples.colour, MIN_SLOPE_COLOUR) ** (-7 / 6), np.float32)


def unclipped_weights(samples: PhotoSamples) -> NDArray[np.float32]:
    """`perceptual_weights`, 0 where the photo is clipped at white."""
    return perceptual_weights(samples) * (samples.colour < CLIPPED)


def observed_weight(photos: Sequence[PhotoSamples], texels: int) -> Floats:
    """Total weight (texels,) of the pixels that show each texel."""
    out = np.zeros(texels)
    for photo in photos:
        out += np.bincount(photo.texel, photo.weight, texels)
    return out


@dataclass(frozen=True)
class MetalTexels:
    """Texels (m,) detected as metal, with linear base colour (m, 3) and roughness (m,); `dielectric` the same of the other decided ones."""

    texel: NDArray[np.int64]
    base: Floats
    roughness: Floats
    dielectric: tuple[NDArray[np.int64], Floats, Floats]


@dataclass(frozen=True)
class LinearShading:
    """Shading of a photo's pixels as a linear function of base colour: shade = b · `slope` + `offset`, both (n, 3)."""

    slope: NDArray[np.float32]
    offset: NDArray[np.float32]

    @classmethod
    def of(cls, samples: PhotoSamples, roughness: NDArray[np.float32], metallic: float) -> LinearShading:
        """The shading of `samples` at `roughness` (texels,) and `metallic` 0 or 1."""
        offset = samples.shade(0.0, roughness, metallic)
        return cls(samples.shade(1.0, roughness, metallic) - offset, offset)

    def error(self, colour: NDArray[np.float32], base: NDArray[Any]) -> NDArray[np.float32]:
        """Errors (n, 3) in sRGB, clipped at white, of base colours `base` (n, 3) against linear `colour` (n, 3)."""
        return np.asarray(encode(np.clip(base * self.slope + self.offset, 0, 1)) - encode(colour))

    def residual(self, samples: PhotoSamples, base: Floats) -> Floats:
        """Weighted pseudo-Huber errors (texels,) of base colours `base` (texels, 3)."""
        error = self.error(samples.colour, base[samples.texel])
        robust = (np.sqrt(error**2 + ROBUST_SCALE**2) - ROBUST_SCALE).sum(1)
        return np.asarray(np.bincount(samples.texel, samples.weight * robust, len(base)), np.float64)


class _LeastSquares:
    """Normal equations of each texel's base colour b in shade = b · slope + offset."""

    def __init__(self, texels: int) -> None:
        self.slopes, self.mixed = np.zeros((texels, 3)), np.zeros((texels, 3))

    def add(self, samples: PhotoSamples, weight: NDArray[Any], shading: LinearShading) -> None:
        rest = samples.colour - shading.offset
        for k in range(3):
            w, a, d = weight[:, k], shading.slope[:, k], rest[:, k]
            for total, value in ((self.slopes, w * a * a), (self.mixed, w * a * d)):
                total[:, k] += np.bincount(samples.texel, value, len(total))

    def solve(self, lowest: float) -> Floats:
        """b (texels, 3) within [lowest, 1]."""
        return np.clip(self.mixed / np.maximum(self.slopes, 1e-12), lowest, 1.0)


def majority_vote(metal: NDArray[np.bool_], decided: NDArray[np.bool_], average: Callable[[Floats], Floats]) -> NDArray[np.bool_]:
    """Which of the `decided` (n,) texels have a majority of `metal` (n,) among decided neighbours, weighed by the filter `average`."""
    share = average((metal & decided).astype(np.float64))
    return np.asarray(decided & (share > MAJORITY * average(decided.astype(np.float64))))


def find_metals(
    photos: Sequence[PhotoSamples], own: NDArray[np.float32], average: Callable[[Floats], Floats] = lambda values: values
) -> MetalTexels:
    """The texels better explained as metal; `own` (texels,) is their present roughness.

    `average` filters values (texels,) over similar neighbours, which decide together.
    """
    texels = len(own)
    dielectric, metal = _compare_models(photos, own)
    visible = sum((average((np.bincount(e.texel, e.weight, texels) > 0).astype(np.float64)) > MIN_PHOTO_SHARE for e in photos),
                  np.zeros(texels, int))  # fmt: skip
    decided = (observed_weight(photos, texels) > MIN_WEIGHT) & (visible >= MIN_PHOTOS)
    count = np.maximum(average(decided.astype(np.float64)), 1e-9)
    albedo = average(np.where(decided, metal.base.mean(1), 0.0)) / count
    ratio = np.where(albedo < CLEAN_METAL_ALBEDO, *MAX_RESIDUAL_RATIO)
    better = np.asarray(average(metal.residual) < ratio * average(dielectric.residual))
    is_metal = majority_vote(better, decided, average)
    chosen, others = np.flatnonzero(is_metal), np.flatnonzero(decided & ~is_metal)
    rest = others, dielectric.base[others], dielectric.roughness[others]
    return MetalTexels(chosen, metal.base[chosen], metal.roughness[chosen], rest)


class _BestModel:
    """The base colour (texels, 3) and roughness (texels,) with the lowest `residual` (texels,) so far."""

    def __init__(self, texels: int) -> None:
        self.residual, self.base, self.roughness = np.full(texels, np.inf), np.zeros((texels, 3)), np.zeros(texels)

    def offer(self, residual: Floats, base: Floats, roughness: NDArray[np.float32]) -> None:
        better = residual < self.residual
        self.residual[better], self.base[better], self.roughness[better] = residual[better], base[better], roughness[better]


def _compare_models(photos: Sequence[PhotoSamples], own: NDArray[np.float32]) -> tuple[_BestModel, _BestModel]:
    """The best dielectric and the best metal of each texel over all roughnesses tried."""
    texels = len(own)
    weights = [unclipped_weights(e) for e in photos]
    dielectric, metal = _BestModel(texels), _BestModel(texels)
    for tried in (own, *(np.full(texels, r, np.float32) for r in TRIED_ROUGHNESS)):
        for metallic, lowest in ((0.0, 0.0), (1.0, MIN_METAL_ALBEDO)):
            if metallic and tried is own:
                tried = np.minimum(own, np.float32(MAX_METAL_ROUGHNESS))
            shadings = [LinearShading.of(samples, tried, metallic) for samples in photos]
            equations = _LeastSquares(texels)
            for samples, weight, shading in zip(photos, weights, shadings, strict=True):
                equations.add(samples, weight, shading)
            b = equations.solve(lowest)
            residual = sum((s.residual(samples, b) for samples, s in zip(photos, shadings, strict=True)), np.zeros(texels))
            (metal if metallic else dielectric).offer(residual, b, tried)
    return dielectric, metal
