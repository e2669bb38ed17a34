"""Metal detection: a dielectric and a metallic model of every texel compared on all photos under the present light.

Gradient steps do not turn a dielectric into a metal: on the way it loses its diffuse colour before it gains a reflection. Under a known
environment, though, both models are linear in the base colour b,

    dielectric: shade = b · T E(n) + L(d) · (.04 A + B)        metal: shade = b · L(d) A + L(d) B

so for each of a few roughnesses the best b is a weighted least-squares solution over the texel's pixels; weights contain the squared slope
of the sRGB curve, so that errors count as they are displayed. The two are compared by their likelihood. Its standard deviation differs
from pixel to pixel: normals are a few degrees off, which hardly changes a diffuse colour and moves a metal's reflections a lot. So it is
the noise of photos together with the change of the predicted colour when the normal is tilted (propagation of uncertainty). Where equal
residuals would favour the dielectric, whose predictions are nearly constant, that decides for the metal, and where a metal predicts a
uniform reflection, as under an overcast sky, an error counts in full. Student's t distribution keeps one misplaced reflection from
outweighing the other pixels. Colours are clipped at white: displays are no brighter.

A metal must reflect clearly more of every channel than the 4 % of dielectrics, else glossy black would pass for a dark metal: clean metals
reflect a third or more (gold's blue is .34: Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014), rusty, anodised and dirty ones go down
to .1. A texel has too few pixels to decide by itself: likelihoods are averaged over neighbours of similar colour (`bilateral`), and
isolated texels follow the majority around them.
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
#: Lowest linear base colour of a metal.
MIN_METAL_ALBEDO = 0.1
#: Share of metal among similar neighbours above which a texel is metal: removes isolated texels and fills isolated gaps.
MAJORITY = 0.5
#: Linear values above this are taken as clipped.
CLIPPED = 0.95
#: Noise of sRGB values (0..1), and degrees of freedom of Student's t distribution of their errors.
NOISE, DEGREES_OF_FREEDOM = 0.01, 3.0
#: Standard deviation of normals, as a length added to the unit normal along each tangent.
NORMAL_ERROR = 0.035
#: Lowest linear colour at which the slope of the sRGB curve is taken.
MIN_SLOPE_COLOUR = 0.02
#: Texels with less weight of pixels than the first are undecided, as are those visible in fewer photos than the second: from few directions
#: a dielectric under a slightly wrong light passes for metal. A photo counts for a texel from the third share of pixels around it.
MIN_WEIGHT, MIN_PHOTOS, MIN_PHOTO_SHARE = 0.3, 6, 0.05

#: Shades pixels of one photo: (base colour 0 or 1, roughness (texels,), metallic 0 or 1) to linear colours (n, 3).
Shader = Callable[[float, NDArray[np.float32], float], NDArray[np.float32]]


@dataclass(frozen=True)
class PhotoSamples:
    """n pixels of one photo: the `texel` (n,) each shows, its linear `colour` (n, 3), `weight` (n,), the `block` (n,) of the photo it lies
    in, the function that shades them, and functions that shade them with normals `tilted` by `NORMAL_ERROR` along a tangent each."""

    texel: NDArray[np.int64]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    block: NDArray[np.int32]
    shade: Shader
    tilted: tuple[Shader, ...] = ()


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
    def of(cls, shade: Shader, roughness: NDArray[np.float32], metallic: float) -> LinearShading:
        """What `shade` gives at `roughness` (texels,) and `metallic` 0 or 1."""
        offset = shade(0.0, roughness, metallic)
        return cls(shade(1.0, roughness, metallic) - offset, offset)

    def srgb(self, base: NDArray[Any]) -> NDArray[np.float32]:
        """sRGB colours (n, 3), clipped at white, of base colours `base` (n, 3)."""
        return np.asarray(encode(np.clip(base * self.slope + self.offset, 0, 1)), np.float32)


@dataclass(frozen=True)
class ShadingModel:
    """The `shading` of a photo's pixels at one roughness and metallic, and the same with `tilted` normals."""

    shading: LinearShading
    tilted: tuple[LinearShading, ...]

    @classmethod
    def of(cls, samples: PhotoSamples, roughness: NDArray[np.float32], metallic: float) -> ShadingModel:
        """The model of the `samples` at `roughness` (texels,) and `metallic` 0 or 1."""
        shading, *tilted = (LinearShading.of(shade, roughness, metallic) for shade in (samples.shade, *samples.tilted))
        return cls(shading, tuple(tilted))

    def negative_log_likelihood(self, samples: PhotoSamples, base: Floats) -> Floats:
        """Weighted sums (texels,) over pixels and channels, up to a constant, for base colours `base` (texels, 3)."""
        b = base[samples.texel]
        shown = self.shading.srgb(b)
        variance = np.full(shown.shape, NOISE**2, np.float32)
        for tilted in self.tilted:
            variance += np.square(tilted.srgb(b) - shown)
        error = np.square(shown - encode(samples.colour)) / variance
        nll = 0.5 * (DEGREES_OF_FREEDOM + 1) * np.log1p(error / DEGREES_OF_FREEDOM) + 0.5 * np.log(variance)
        return np.asarray(np.bincount(samples.texel, samples.weight * nll.sum(1), len(base)), np.float64)


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
    better = np.asarray(average(metal.cost - dielectric.cost) < 0)
    is_metal = majority_vote(better, decided, average)
    chosen, others = np.flatnonzero(is_metal), np.flatnonzero(decided & ~is_metal)
    rest = others, dielectric.base[others], dielectric.roughness[others]
    return MetalTexels(chosen, metal.base[chosen], metal.roughness[chosen], rest)


class _BestModel:
    """The base colour (texels, 3) and roughness (texels,) with the lowest `cost` (texels,), a negative log-likelihood, so far."""

    def __init__(self, texels: int) -> None:
        self.cost, self.base, self.roughness = np.full(texels, np.inf), np.zeros((texels, 3)), np.zeros(texels)

    def offer(self, cost: Floats, base: Floats, roughness: NDArray[np.float32]) -> None:
        better = cost < self.cost
        self.cost[better], self.base[better], self.roughness[better] = cost[better], base[better], roughness[better]


def _compare_models(photos: Sequence[PhotoSamples], own: NDArray[np.float32]) -> tuple[_BestModel, _BestModel]:
    """The best dielectric and the best metal of each texel over all roughnesses tried."""
    texels = len(own)
    weights = [unclipped_weights(e) for e in photos]
    dielectric, metal = _BestModel(texels), _BestModel(texels)
    for tried in (own, *(np.full(texels, r, np.float32) for r in TRIED_ROUGHNESS)):
        for metallic, lowest in ((0.0, 0.0), (1.0, MIN_METAL_ALBEDO)):
            if metallic and tried is own:
                tried = np.minimum(own, np.float32(MAX_METAL_ROUGHNESS))
            models = [ShadingModel.of(samples, tried, metallic) for samples in photos]
            equations = _LeastSquares(texels)
            for samples, weight, model in zip(photos, weights, models, strict=True):
                equations.add(samples, weight, model.shading)
            b = equations.solve(lowest)
            cost = sum((m.negative_log_likelihood(s, b) for s, m in zip(photos, models, strict=True)), np.zeros(texels))
            (metal if metallic else dielectric).offer(cost, b, tried)
    return dielectric, metal
