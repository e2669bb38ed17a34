"""Search for light intensity, contrast and roughness by variable projection, with base colours solved for each candidate.

Under one fixed environment, brighter light on darker albedo looks nearly the same; only specular reflection, whose strength is known (4 %
at normal incidence), tells them apart. Gradient steps hardly move along that valley; above all a uniform component of the initial light
stays, because base colours have compensated for it. Here, for an environment L, the best base colour b of each texel in

    shade = b · T E(n) + L(d) · (.04 A + B)

is a weighted least-squares solution over its pixels, so residuals depend on the light alone (variable projection; Golub & Pereyra, *The
differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate*, 1973). Candidates are environments

    L' = s · mean(L) · (L / mean(L))^γ / mean of the same

of intensity s and contrast γ, and one shift of logit(roughness) for all dielectric texels, by coordinate descent as long as residuals
fall; at the end the intensity between two steps, by a parabola through the logarithms of the costs, and that of single colour channels.
Roughness takes part because a wrong one biases the light: reflections that a too smooth material would show, and photos do not, favour a
dim, uniform environment, from which coordinate descent in the light alone does not return. Base colours are solved robustly by
reweighting, so that misplaced reflections do not decide. Residuals are of sRGB values, averaged over blocks of a twelfth of the object: a
sharp reflection that is misplaced by a few pixels would otherwise favour a darker light, by regression dilution (Fuller, *Measurement
Error Models*, 1987).

On rough materials reflections hardly tell the intensity, and the residual is flat over a factor of three. There a prior decides. The
residuals count as `OBSERVATIONS` independent ones of a Laplace distribution:

    −log p = OBSERVATIONS · log residual − log prior

The prior. A brighter light on a darker surface looks the same, on metal exactly so.

Three quantities are known roughly before any photo is looked at, and an intensity is likely where all of them are:

- the geometric mean of the strongest channel of dielectrics' base colours,
- the median of that of metals. Those of pure metals are tabulated (silver, aluminium, gold, copper, chromium, nickel, titanium, cobalt,
  platinum and iron: Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014, table 4),
- the mean radiance of a light that stands, since photographers expose for it: in it white paper is as bright as that. `python -m
  benchmarks.light_levels` measures environment maps that others have published. A flash, which moves with the camera, is one bright spot.

The logarithm of each follows Student's t with two degrees of freedom: some objects are black, and some lights those of a night. The light's
scale is that of the environment maps' quartiles; metals' .4 where the tabulated ones have .28, as worn and dirty ones differ more. Where
two quantities contradict each other such a prior has two modes, between which small changes would decide; so its mean is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from gsbake.materials.linear_shading import BaseColourSolver, PhotoSamples
from gsbake.materials.surface import Materials
from gsbake.materials.visibility import LUMINANCE
from gsbake.shading.cubemap import solid_angles

Floats = NDArray[np.float64]

#: Search steps: factor on intensity, exponent of contrast, shift of logit(roughness).
INTENSITY_FACTOR, CONTRAST_EXPONENT, ROUGHNESS_STEP = 1.2, 1.15, 0.4


@dataclass(frozen=True)
class LightSearchOptions:
    """Constants of the search for the light, and of the prior of its intensity."""

    #: Directions of search in steps of intensity, contrast and roughness, in order. Never smoother: a blurred environment favours that.
    directions: tuple[tuple[int, ...], ...] = ((-1, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1))
    #: Start of a second search, in steps: bright light on rough material is a separate local minimum.
    second_start: tuple[int, ...] = (2, 0, 4)
    #: Relative decrease of the residual that a step must bring; a step with more roughness; the result of the second search.
    min_decrease: float = 0.002
    min_rougher_decrease: float = 0.01
    min_second_decrease: float = 0.03
    #: Costs below this are noise.
    min_cost: float = 1e-9


OPTIONS = LightSearchOptions()

#: Factor on the intensity of single channels, tried at the end.
TINT_FACTOR = 1.1
#: Bounds of the search: factor of intensity, factor of the contrast exponent, shift of logit(roughness).
LIMITS = (3.0, 2.0, 3.0)
#: Number of independent residuals that evidence for the intensity counts as: errors of the model are shared by all pixels.
OBSERVATIONS = 10.0


@dataclass(frozen=True)
class LightAdjustment:
    """Result of `search_light`: factors `intensity` (3,) and exponent `contrast` on the environment, `roughness_shift` of logit(roughness)
    of dielectrics, and `improvement`, the relative decrease of the residual, prior included."""

    intensity: Floats
    contrast: float
    roughness_shift: float
    improvement: float

    def __str__(self) -> str:
        red, green, blue = self.intensity
        roughness = f", roughness logit {self.roughness_shift:+.1f}" if self.roughness_shift else ""
        light = f"RGB factors {red:.2f} {green:.2f} {blue:.2f}, contrast {self.contrast:.2f}"
        return f"{light}{roughness} (residual -{self.improvement:.1%})"

    def shifted_roughness(self, roughness: NDArray[np.floating]) -> NDArray[np.float32]:
        """`roughness` (n,) of dielectrics after the shift."""
        return shift_roughness(roughness, self.roughness_shift)


def shift_roughness(roughness: NDArray[np.floating], shift: float) -> NDArray[np.float32]:
    """`roughness` (n,) with `shift` added to its logit."""
    odds = np.clip(roughness, 1e-4, 1 - 1e-4)
    odds = odds / (1 - odds) * np.exp(shift)
    return np.asarray(odds / (1 + odds), np.float32)


def adjust_radiance(
    radiance: NDArray[np.floating], intensity: NDArray[np.floating], contrast: float, area: NDArray[np.floating]
) -> NDArray[np.float32]:
    """The environment `radiance` (6, s, s, 3) with its mean over the sphere (texels weighted by solid angles `area` (6, s, s)) times
    `intensity` (3,), and each direction's ratio to that mean raised to `contrast`."""

    def mean(light: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.asarray((light * area[..., None]).sum((0, 1, 2)) / area.sum())

    average = np.maximum(mean(radiance), 1e-12)
    shape = (np.maximum(radiance, 1e-6) / average) ** contrast
    return np.asarray(intensity * average * shape / mean(shape), np.float32)


def search_light(
    samples: Callable[[Floats, float], Sequence[PhotoSamples]],
    roughness: NDArray[np.float32],
    tint: bool = True,
    rough: bool = True,
    prior: IntensityPrior | None = None,
) -> LightAdjustment:
    """The intensity of each colour channel, the contrast and the roughness shift with the lowest residual.

    `samples` gives the pixels of all photos under the environment of an intensity (3,) and a contrast; `roughness` (n,) is that of the
    texels. Without `tint` the ratio of the channels is fixed. Without `rough` the roughness is fixed; with it, a second search starts at
    `second_start`. A `prior` of the intensity counts as well.
    """
    residuals: dict[_Candidate, Floats] = {}
    lit: dict[tuple[float, ...], Sequence[PhotoSamples]] = {}

    def residual(candidate: _Candidate) -> Floats:
        if candidate not in residuals:
            light = (*candidate.intensity, CONTRAST_EXPONENT**candidate.contrast_steps)
            if light not in lit:
                lit[light] = samples(candidate.intensity, light[-1])
            residuals[candidate] = block_residual(lit[light], shift_roughness(roughness, ROUGHNESS_STEP * candidate.roughness_steps))
        return residuals[candidate]

    def cost(candidate: _Candidate) -> float:
        open_to_prior = 0.0 if prior is None else prior.negative_log(candidate.brightness)
        return float(residual(candidate).sum() * math.exp(open_to_prior / OBSERVATIONS))

    def descend(best: _Candidate) -> _Candidate:
        moved = True
        while moved:
            moved = False
            for direction in (direction for direction in OPTIONS.directions if rough or not direction[2]):
                bound = 1 - (OPTIONS.min_rougher_decrease if direction[2] else OPTIONS.min_decrease)
                tried = best.step(*direction)
                while tried.within_limits and cost(tried) < bound * cost(best):
                    best, tried, moved = tried, tried.step(*direction), True
        return best

    def between_steps(best: _Candidate) -> _Candidate:
        below, here, above = (math.log(max(cost(best.step(k, 0, 0)), OPTIONS.min_cost)) for k in (-1, 0, 1))
        if (curvature := below - 2 * here + above) <= 0:
            return best
        tried = best.step(float(np.clip((below - above) / (2 * curvature), -1, 1)), 0, 0)
        return tried if cost(tried) < cost(best) else best

    start = _Candidate(0, 0, 0)
    best = descend(start)
    if rough:
        second = descend(start.step(*OPTIONS.second_start))
        best = second if cost(second) < (1 - OPTIONS.min_second_decrease) * cost(best) else best
    best = between_steps(best)
    if tint:
        best = _tinted(best, residual)
    improvement = 1 - cost(best) / max(cost(start), 1e-12)
    return LightAdjustment(best.intensity, CONTRAST_EXPONENT**best.contrast_steps, ROUGHNESS_STEP * best.roughness_steps, improvement)


@dataclass(frozen=True)
class _Candidate:
    """A candidate, in steps of intensity, contrast and roughness, and of each colour channel's tint."""

    intensity_steps: float
    contrast_steps: int
    roughness_steps: int
    tint: tuple[int, ...] = (0, 0, 0)

    @property
    def intensity(self) -> Floats:
        return INTENSITY_FACTOR**self.intensity_steps * np.power(TINT_FACTOR, np.array(self.tint, np.float64))

    @property
    def brightness(self) -> float:
        """Geometric mean of the channels' intensities."""
        return float(np.exp(np.log(self.intensity).mean()))

    @property
    def within_limits(self) -> bool:
        intensity, contrast = INTENSITY_FACTOR ** abs(self.intensity_steps), CONTRAST_EXPONENT ** abs(self.contrast_steps)
        change = intensity, contrast, ROUGHNESS_STEP * abs(self.roughness_steps)
        return all(value <= limit for value, limit in zip(change, LIMITS, strict=True))

    def step(self, intensity: float, contrast: int, roughness: int) -> _Candidate:
        return _Candidate(self.intensity_steps + intensity, self.contrast_steps + contrast, self.roughness_steps + roughness, self.tint)


def _tinted(best: _Candidate, residual: Callable[[_Candidate], Floats]) -> _Candidate:
    """`best` with one or two channels a step dimmer or brighter, where that lowers the residual."""
    for sign in (-1, 1):
        all_channels = replace(best, tint=(sign, sign, sign))
        lower = residual(all_channels) < (1 - OPTIONS.min_decrease) * residual(best)
        tried = replace(best, tint=tuple(sign * int(channel) for channel in lower))
        if 0 < lower.sum() < 3 and residual(tried).sum() < residual(best).sum():
            return tried
    return best


def block_residual(photos: Sequence[PhotoSamples], roughness: NDArray[np.float32]) -> Floats:
    """Block-averaged absolute residuals (3,) of sRGB values at the best base colours."""
    shadings = [photo.shade(roughness).dielectric for photo in photos]
    base = BaseColourSolver(photos, len(roughness)).solve(shadings, robust=True)
    total, pixels = np.zeros(3), 0.0
    for photo, shading in zip(photos, shadings, strict=True):
        error = (shading.srgb(base[photo.texel]) - photo.encoded) * photo.weight[:, None]
        total += [np.abs(np.bincount(photo.block, error[:, k])).sum() for k in range(3)]
        pixels += float(photo.weight.sum())
    return total / max(pixels, 1e-12)


#: Median, and scale of the logarithm, of base colours of dielectrics and of metals, and of the light's mean radiance.
DIELECTRICS, METALS, RADIANCE = (0.3, 0.66), (0.66, 0.4), (0.7, 0.29)
#: Least share of texels of a kind whose base colours count; what is added to those of dielectrics, so that black places do not decide.
MIN_SHARE, LOG_OFFSET = 0.05, 0.01
#: Factors on the intensity over which `mean_factor` integrates, and those at which photos are compared for `open_factors`.
FACTORS = np.exp(np.linspace(-math.log(4), math.log(4), 121))
TRIED_FACTORS = FACTORS[::10]


@dataclass(frozen=True)
class IntensityPrior:
    """Present means of the base colours of `dielectrics` and of `metals`, and of the light's `radiance`; None where one does not count."""

    dielectrics: float | None = None
    metals: float | None = None
    radiance: float | None = None

    @classmethod
    def of(cls, materials: Materials, dielectric: NDArray[np.bool_], radiance: NDArray[np.float32] | None) -> IntensityPrior:
        """The prior for texels with `materials`, of which some (n,) are `dielectric`, under the environment map `radiance` (6, s, s, 3),
        which does not count without."""
        strongest, metal = materials.base_color.max(1), materials.metallic > 0.5
        dielectrics = float(np.exp(np.log(strongest[dielectric] + LOG_OFFSET).mean())) if dielectric.mean() >= MIN_SHARE else None
        metals = float(np.median(strongest[metal])) if metal.mean() >= MIN_SHARE else None
        if radiance is None:
            return cls(dielectrics, metals)
        area = solid_angles(radiance.shape[1])
        return cls(dielectrics, metals, float(((radiance @ LUMINANCE) * area).sum() / area.sum()))

    def negative_log(self, factor: float) -> float:
        """−log of the prior, up to a constant, of the light times `factor`, under which base colours are divided by it."""
        known = ((self.dielectrics, 1 / factor, DIELECTRICS), (self.metals, 1 / factor, METALS), (self.radiance, factor, RADIANCE))
        return sum(_negative_log(value * change, *prior) for value, change, prior in known if value)

    def mean_factor(self) -> float:
        """The geometric mean of the factor on the intensity under the prior, between 1/4 and 4."""
        cost = np.array([self.negative_log(factor) for factor in FACTORS])
        density = np.exp(cost.min() - cost)
        return float(np.exp(density @ np.log(FACTORS) / density.sum()))

    def open_factors(self, residuals: NDArray[np.floating] | None = None) -> tuple[float, float]:
        """The least and the largest factor on the intensity, between 1/4 and 4, whose posterior is above e⁻² of the highest.

        `residuals` (k,) are those of photos at `TRIED_FACTORS`; None: the prior alone.
        """
        cost = np.array([self.negative_log(factor) for factor in FACTORS], np.float64)
        if residuals is not None:
            logarithm = np.log(np.maximum(residuals, OPTIONS.min_cost))
            cost += OBSERVATIONS * CubicSpline(np.log(TRIED_FACTORS), logarithm)(np.log(FACTORS))
        likely = FACTORS[cost <= cost.min() + 2]
        return float(likely[0]), float(likely[-1])


def _negative_log(value: float, median: float, scale: float) -> float:
    """−log of Student's t of log(value), up to a constant."""
    return 1.5 * math.log1p(0.5 * (math.log(value / median) / scale) ** 2)
