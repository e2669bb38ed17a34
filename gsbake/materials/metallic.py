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
outweighing the other pixels. Pixels clipped at white are lower bounds, and where all are clipped nothing is decided.

A metal must reflect clearly more of every channel than the 4 % of dielectrics, else glossy black would pass for a dark metal: clean metals
reflect a third or more (gold's blue is .34: Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014), rusty, anodised and dirty ones go down
to .1. A texel has too few pixels to decide by itself: likelihoods are averaged over neighbours of similar appearance (`bilateral`), and
isolated texels follow the majority around them. Neighbours of nearly the same fitted material come first; where even they do not tell, a
wider neighbourhood of similar photos does, in which narrow metal between wood of its colour would be outvoted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel
from gsbake.materials.fit_kernel import srgb_and_slope
from gsbake.materials.linear_shading import CLIPPED, BaseColourSolver, LinearParts, PhotoSamples, observed_weight

Floats = NDArray[np.float64]
#: A filter of values (texels,).
Average = Callable[[Floats], Floats]

#: Roughnesses tried beside a texel's own.
TRIED_ROUGHNESS = (0.1, 0.2, 0.35, 0.55)


@dataclass(frozen=True)
class MetalDetectionOptions:
    """Constants of metal detection."""

    #: Roughest metal: rougher ones shade like dielectrics, and oxides, which are rough, are dielectrics.
    max_metal_roughness: float = 0.6
    #: Share of metal among similar neighbours above which a texel is metal: removes isolated texels and fills isolated gaps.
    majority: float = 0.5
    #: Mean log-likelihood ratio per pixel from which the nearer neighbourhood decides.
    clear_evidence: float = 2.0
    #: Noise of sRGB values (0..1), and degrees of freedom of Student's t distribution of their errors.
    noise: float = 0.01
    degrees_of_freedom: float = 3.0


OPTIONS = MetalDetectionOptions()

#: Lowest linear base colour of a metal.
MIN_METAL_ALBEDO = 0.1
#: Texels with less weight of unclipped pixels than the first are undecided, as are those visible in fewer photos than the second: from few
#: directions a dielectric under a slightly wrong light passes for metal. A photo counts from the third share of pixels around a texel.
MIN_WEIGHT, MIN_PHOTOS, MIN_PHOTO_SHARE = 0.3, 6, 0.05


@dataclass(frozen=True)
class MetalTexels:
    """Texels (m,) detected as metal, with linear base colour (m, 3) and roughness (m,); `dielectric` the same of the other decided ones."""

    texel: NDArray[np.int64]
    base: Floats
    roughness: Floats
    dielectric: tuple[NDArray[np.int64], Floats, Floats]


@kernel("i8[::1], f4[:, ::1], f4[:, :, ::1], f4[:, :, ::1], f8[:, ::1], f4, f4, f4[::1]", parallel=True, nogil=True, error_model="numpy")
def pixel_costs(texel: Any, encoded: Any, slope: Any, offset: Any, base: Any, noise: Any, freedom: Any, cost: Any) -> None:
    """`cost` (n,): −log of the likelihood of n pixels, up to a constant, summed over channels.

    They show `texel` (n,) as base · slope + offset, the first of `slope` and `offset` (k, n, 3) with the normal as it is, the others with
    tilted ones, where the photo has the sRGB colour `encoded` (n, 3). The variance is `noise` and the squared changes by the tilts.
    """
    for i in prange(len(texel)):
        errors = variances = np.float32(1)  # products over channels, as logarithms take long
        for c in range(3):
            b, variance = np.float32(base[texel[i], c]), noise
            shown = srgb_and_slope(min(max(b * slope[0, i, c] + offset[0, i, c], np.float32(0)), np.float32(1)))[0]
            for k in range(1, len(slope)):
                change = srgb_and_slope(min(max(b * slope[k, i, c] + offset[k, i, c], np.float32(0)), np.float32(1)))[0] - shown
                variance += change * change
            error = shown - encoded[i, c]
            errors *= np.float32(1) + error * error / (variance * freedom)
            variances *= variance
        cost[i] = np.float32(0.5) * ((freedom + np.float32(1)) * math.log(errors) + math.log(variances))


def _itself(values: Floats) -> Floats:
    return values


def majority_vote(metal: NDArray[np.bool_], decided: NDArray[np.bool_], average: Average) -> NDArray[np.bool_]:
    """Which of the `decided` (n,) texels have a majority of `metal` (n,) among decided neighbours, weighed by the filter `average`."""
    share = average((metal & decided).astype(np.float64))
    return np.asarray(decided & (share > OPTIONS.majority * average(decided.astype(np.float64))))


def find_metals(photos: Sequence[PhotoSamples], own: NDArray[np.float32], near: Average = _itself, wide: Average = _itself) -> MetalTexels:
    """The texels better explained as metal; `own` (texels,) is their present roughness.

    `near` and `wide` filter values (texels,) over a smaller and a larger neighbourhood of each texel, which decides together.
    """
    texels = len(own)
    dielectric, metal = _compare_models(photos, own)
    telling = [replace(e, weight=e.weight * (e.colour < CLIPPED).any(1)) for e in photos]
    visible = np.zeros(texels, int)
    for e in telling:
        for texel, weight in zip(np.split(e.texel, e.start), np.split(e.weight, e.start), strict=True):
            visible += wide((np.bincount(texel, weight, texels) > 0).astype(np.float64)) > MIN_PHOTO_SHARE
    decided = (observed_weight(telling, texels) > MIN_WEIGHT) & (visible >= MIN_PHOTOS)
    difference = metal.cost - dielectric.cost
    evidence = near(difference) / np.maximum(near(observed_weight(photos, texels)), 1e-6)
    better = np.where(np.abs(evidence) > OPTIONS.clear_evidence, evidence, wide(difference)) < 0
    is_metal = majority_vote(better, decided, near)
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


def shaded(photos: Sequence[PhotoSamples], roughness: NDArray[np.float32]) -> list[list[LinearParts]]:
    """The shading of each photo's pixels at a `roughness` (texels,), followed by those with tilted normals."""
    return [[shade(roughness) for shade in (samples.shade, *samples.tilted)] for samples in photos]


def candidate_model(
    photos: Sequence[PhotoSamples], solver: BaseColourSolver, parts: Sequence[Sequence[LinearParts]], metal: bool
) -> tuple[Floats, Floats]:
    """The best model of one kind with the shading `parts` of `shaded`: costs (texels,), which are negative log-likelihoods up to a
    constant, and base colours (texels, 3)."""
    base = solver.solve([plain.of(metal) for plain, *_ in parts], MIN_METAL_ALBEDO if metal else 0.0)
    costs, noise, freedom = np.zeros(len(base)), np.float32(OPTIONS.noise**2), np.float32(OPTIONS.degrees_of_freedom)
    for samples, shadings in zip(photos, parts, strict=True):
        slope, offset = (np.stack([getattr(one.of(metal), part) for one in shadings]) for part in ("slope", "offset"))
        cost = np.empty(len(samples.texel), np.float32)
        pixel_costs(samples.texel, samples.encoded, slope, offset, base, noise, freedom, cost)
        costs += np.bincount(samples.texel, samples.weight * cost, len(base))
    return costs, base


def _compare_models(photos: Sequence[PhotoSamples], own: NDArray[np.float32]) -> tuple[_BestModel, _BestModel]:
    """The best dielectric and the best metal of each texel over all roughnesses tried."""
    texels = len(own)
    solver, found = BaseColourSolver(photos, texels), (_BestModel(texels), _BestModel(texels))
    for roughness in (own, *(np.full(texels, tried, np.float32) for tried in TRIED_ROUGHNESS)):
        parts = shaded(photos, roughness)
        found[False].offer(*candidate_model(photos, solver, parts, False), roughness)
        cost, base = candidate_model(photos, solver, parts, True)
        found[True].offer(np.where(roughness > OPTIONS.max_metal_roughness, np.inf, cost), base, roughness)
    return found
