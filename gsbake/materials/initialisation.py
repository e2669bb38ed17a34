"""Start of the material fit: initial metallic and roughness, compared on validation photos.

Gradient steps find the optimum near their start. A surface that starts too rough cannot localise light, and its reflections end up in base
colour; one that starts dielectric explains a metal's reflections by a diffuse base colour under a light of their colour, and stays there.
So short fits on the coarse level, from all-dielectric and all-metal starts of several roughnesses, are compared on photos that they were
not fitted to. On the way `MaterialFit` decides texel by texel between metal and dielectric, so either start can end as any mixture. Those
close to the best are continued with all searches, on the coarse level, and compared again.

They are compared by a robust error: a sharp reflection a few pixels off counts twice in the squared error, where it is and where it should
be, so that the PSNR prefers materials that are too rough. Fits that started with another roughness often explain the photos as well, by a
brighter or a dimmer light: there its prior decides (`intensity_prior`), but not between metal and dielectric. Where both kinds explain the
photos, the object is dielectric, as most are.

A capture too small for validation photos distinguishes metals from dielectrics all the same, but not the roughness of dielectrics: every
fourth photo is held out while the best starts of the two kinds are compared, and all are fitted from the start that is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from gsbake.capture.photos.roles import held_out
from gsbake.materials.concurrent_fits import Each, run_concurrently
from gsbake.materials.fit import MaterialFit
from gsbake.materials.fit_surface import Fitted, validation_error
from gsbake.materials.levels import FitLevel
from gsbake.materials.light_intensity import OBSERVATIONS
from gsbake.materials.options import FitSchedule

#: Compared starts: metallic and roughness.
METAL_STARTS = ((0.9, 0.2), (0.9, 0.45))
STARTS = ((0.05, 0.2), (0.05, 0.45), (0.05, 0.8), *METAL_STARTS)
#: When trials search for metals, as shares of their steps.
METAL_SEARCHES_AT = (0.4, 0.8)
#: When the light of a mostly metallic object is scaled: metals are found with the light that they have.
LIGHT_SCALED_AT = (0.6,)
#: Start of a diffuse object, and without validation photos.
DIFFUSE_START, DEFAULT_START = (0.05, 0.8), (0.05, 0.45)
#: Without validation photos every so many photos are held out while metal is compared with dielectric.
KIND_HOLDOUT = 4
#: Starts whose error is within this factor of the best one are continued as well, at most so many in all.
CANDIDATE_FACTOR, MAX_CANDIDATES = 1.3, 3
#: A metallic start must have less error than the best dielectric one, by this share; by more where the light moves, as such a light is an
#: approximation, to whose errors rough metal adapts.
METAL_MARGIN, MOVING_METAL_MARGIN = 0.04, 0.1

#: Initial metallic and roughness.
Start = tuple[float, float]
#: Trials by their start, with their results.
Trials = dict[Start, tuple[MaterialFit, Fitted]]
#: Builds a fit on the coarse level from a start.
MakeFit = Callable[[float, float], MaterialFit]


@dataclass(frozen=True)
class ChosenFit:
    """The chosen `fit` with its result `fitted`, its initial `metallic` and `roughness`, the number of continued `fits`, and the
    `evidence`."""

    fit: MaterialFit
    fitted: Fitted
    metallic: float
    roughness: float
    fits: int
    evidence: str


def trial_schedule(steps: int, seed: int, diffuse: bool) -> FitSchedule:
    """What a trial of `steps` steps does."""
    return FitSchedule(
        steps,
        seed,
        METAL_SEARCHES_AT,
        emission=False,
        light_searches_at=(),
        light_scaled_at=LIGHT_SCALED_AT,
        sparsity=False,
        diffuse=diffuse,
        normals=False,
    )


def compared_starts(make: MakeFit, level: FitLevel, plan: FitSchedule, each: Each) -> tuple[tuple[Start, ...], str]:
    """The starts to compare by trials of `plan` on the coarse `level`, and why, where that is one: of a diffuse object, or without
    validation photos."""
    if plan.diffuse:
        return (DIFFUSE_START,), "diffuse object"
    if any(map(len, level.held_out)):
        return STARTS, ""
    apart = set(held_out(len(level.fitted), KIND_HOLDOUT))
    if not apart:
        return (DEFAULT_START,), "no validation photos"
    kept, chosen = ([photo for i, photo in enumerate(level.fitted) if (i in apart) == role] for role in (False, True))
    trials = trial_fits(make, replace(level, fitted=kept, held_out=chosen), STARTS, plan, each)
    errors = {start: validation_error(fitted) for start, (_, fitted) in trials.items()}
    metal, dielectric = (min((s for s in STARTS if (s in METAL_STARTS) == kind), key=lambda s: errors[s]) for kind in (True, False))
    start = metal if errors[metal] < (1 - _metal_margin(trials)) * errors[dielectric] else DEFAULT_START
    return (start,), f"no validation photos; by every {KIND_HOLDOUT}th photo, fitted afterwards: {_percent(errors)}"


def trial_fits(make: MakeFit, level: FitLevel, starts: Sequence[Start], plan: FitSchedule, each: Each) -> Trials:
    """Fits from `starts` on the coarse `level`. Those that start dielectric, under a light that stands, start without the shading in the
    projected colours."""
    fits: dict[Start, MaterialFit] = {}
    stands, shading = all(photo.to_light is None for photo in level.fitted), None
    for metallic, roughness in starts:
        fit = fits[metallic, roughness] = make(metallic, roughness)
        if stands and fit.mostly_dielectric:
            shading = fit.find_remaining_shading(plan.seed) if shading is None else shading  # the same from every start
            fit.move_to_light(shading, plan.seed)
    return _run(fits, level, plan, each)


def _run(fits: dict[Start, MaterialFit], level: FitLevel, plan: FitSchedule, each: Each) -> Trials:
    """The `fits` with their results on `level`, several at a time."""
    results = run_concurrently([partial(fit.run, level.fitted, level.held_out, plan) for fit in fits.values()], each)
    return dict(zip(fits, zip(fits.values(), results, strict=True), strict=True))


def best_fit(trials: Trials, level: FitLevel, plan: FitSchedule, each: Each, reason: str = "") -> ChosenFit:
    """The fit with the least validation error on `level` of those that continue the best of the `trials` by `plan`; `reason` is the
    evidence for a single one."""
    errors = {start: validation_error(fitted) for start, (_, fitted) in trials.items()}
    evidence = _percent(errors) if len(errors) > 1 else reason
    found = _run({start: trials[start][0] for start in candidates(errors)}, level, plan, each)
    continued = {start: validation_error(fitted) for start, (_, fitted) in found.items()}
    weighed = {start: error * _prior_factor(found[start][0]) for start, error in continued.items()}
    kinds = [[start for start in weighed if (start[0] < 0.5) == dielectric] for dielectric in (True, False)]
    finalists = [min(kind, key=lambda start: weighed[start]) for kind in kinds if kind]
    margin = _metal_margin(found)
    best = min(finalists, key=lambda start: continued[start] * (1 - margin if start[0] < 0.5 else 1))
    if len(continued) > 1:
        evidence += f"; continued: {_percent(continued)}; with the prior of the light: {_percent(weighed)}"
    return ChosenFit(*found[best], *best, len(continued), evidence)


def _metal_margin(trials: Trials) -> float:
    """Share by which a metallic start must have less error than a dielectric one."""
    return MOVING_METAL_MARGIN if any(fit.moving_light for fit, _ in trials.values()) else METAL_MARGIN


def _prior_factor(fit: MaterialFit) -> float:
    """Factor on the error of a fit by the prior of its light's intensity, as in the search for that; 1 where the light moves."""
    return 1.0 if fit.moving_light else math.exp(fit.intensity_prior().negative_log(1) / OBSERVATIONS)


def _percent(errors: dict[Start, float]) -> str:
    """Errors in percent of white."""
    return ", ".join(f"{error:.2%} error from metallic {m:g} roughness {r:g}" for (m, r), error in errors.items())


def candidates(errors: dict[Start, float]) -> list[Start]:
    """The best starts by the `errors` of their trials."""
    order = sorted(errors, key=lambda start: errors[start])
    return [start for start in order if errors[start] <= CANDIDATE_FACTOR * errors[order[0]]][:MAX_CANDIDATES]
