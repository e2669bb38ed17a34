"""Choice of the fit's initial roughness, and of whether to search for metals, on validation views.

The initial roughness decides which light is found: a surface that starts too rough cannot localise light, and its reflections end up in
base colour; one that starts too smooth makes the light blurred. Short trials from a few values are compared on photos that they were not
fitted to. Where two are close, both are fitted in full.

Detected metals should be confirmed by photos that were not fitted. Where those are reproduced nearly as well with metallic 0, the metals
may be white or black dielectrics, and the fit is repeated without them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gsbake.materials.fit import Fitted, MaterialFit
from gsbake.materials.map_selection import without_metal
from gsbake.materials.options import FitSchedule
from gsbake.materials.pixels import Pixels

#: Initial roughness of the trials.
TRIAL_ROUGHNESS = (0.2, 0.45, 0.8)
#: Iterations of a trial, pixels of each photo in it, and every how many-th photo validates it.
TRIAL_STEPS, TRIAL_PIXELS, TRIAL_HOLDOUT = 100, 15_000, 5
#: Trials within this many dB of the best are fitted in full: 100 steps find a blurred light sooner than a sharp one and so favour smooth
#: initial values.
CANDIDATE_MARGIN = 1.0
#: Metals that raise held-out PSNR by less than this many dB are validated by a fit without them.
METAL_MARGIN = 0.5

#: Builds a fit with an initial roughness.
MakeFit = Callable[[float], MaterialFit]


@dataclass(frozen=True)
class ChosenFit:
    """The chosen `fit` and its result `fitted`, its initial `roughness`, the number of full `fits` made, the `evidence` for that roughness,
    and `metal_evidence` where metals were validated by a fit without them."""

    fit: MaterialFit
    fitted: Fitted
    roughness: float
    fits: int
    evidence: str
    metal_evidence: str | None


def best_fit(
    make: MakeFit,
    photos: list[Pixels],
    held_out: list[Pixels],
    steps: int,
    seed: int,
    trials: Mapping[float, float],
    diffuse: bool,
    each: Callable[[int, int], None] | None = None,
) -> ChosenFit:
    """Fit in full from each candidate of the `trials` (PSNR in dB by roughness); take the one with the best PSNR on `held_out`.

    A `diffuse` object starts from the highest roughness and has no metals. Without held-out photos the first candidate is taken.
    """
    starts = roughness_candidates(trials) or [TRIAL_ROUGHNESS[-1] if diffuse else TRIAL_ROUGHNESS[1]]
    starts = starts if any(map(len, held_out)) else starts[:1]
    fits = [make(roughness) for roughness in starts]
    results = [fit.run(photos, held_out, FitSchedule(steps, seed, diffuse=diffuse), each) for fit in fits]
    best = max(range(len(fits)), key=lambda k: results[k].held_out_psnr or 0.0)
    chosen, fitted, made = fits[best], results[best], len(fits)
    evidence = ", ".join(f"{score:.2f} dB from {roughness:g}" for roughness, score in trials.items())
    if len(fits) > 1:
        scores = [f"{f.held_out_psnr:.2f} dB from {r:g}" for f, r in zip(results, starts, strict=True)]
        evidence += f"; full fits: {', '.join(scores)}"
    metal_evidence = None
    dielectric = chosen.psnr(held_out, without_metal(fitted.values)) if fitted.metal.any() else None
    if dielectric is not None and fitted.held_out_psnr is not None and dielectric > fitted.held_out_psnr - METAL_MARGIN:
        again = make(starts[best])
        other = again.run(photos, held_out, FitSchedule(steps, seed, metallic=False), each)
        made += 1
        metal_evidence = f"held-out PSNR {fitted.held_out_psnr:.2f} dB with metals, {other.held_out_psnr or 0.0:.2f} dB fitted without"
        if (other.held_out_psnr or 0.0) > fitted.held_out_psnr:
            chosen, fitted = again, other
    evidence = evidence or ("diffuse object" if diffuse else "too few photos for trials")
    return ChosenFit(chosen, fitted, starts[best], made, evidence, metal_evidence)


def trial_roughness(make: MakeFit, photos: list[Pixels], seed: int, each: Callable[[int, int], None] | None = None) -> dict[float, float]:
    """Validation PSNR in dB of a short fit from each of `TRIAL_ROUGHNESS`.

    Empty with fewer than `TRIAL_HOLDOUT` photos.
    """
    if len(photos) < TRIAL_HOLDOUT:
        return {}
    subset = [p.subsampled(TRIAL_PIXELS) for p in photos]
    validation, training = subset[::TRIAL_HOLDOUT], [p for i, p in enumerate(subset) if i % TRIAL_HOLDOUT]
    found: dict[float, float] = {}
    for turn, roughness in enumerate(TRIAL_ROUGHNESS):
        schedule = FitSchedule(TRIAL_STEPS, seed, metallic=False, emission=False, intensity=False, sparsity=False)
        score = make(roughness).run(training, validation, schedule).held_out_psnr
        if score is not None:
            found[roughness] = score
        if each is not None:
            each(turn + 1, len(TRIAL_ROUGHNESS))
    return found


def roughness_candidates(trials: Mapping[float, float]) -> list[float]:
    """The roughnesses of `trials` (PSNR in dB of each) within `CANDIDATE_MARGIN` of the best, best first."""
    order = sorted(trials, key=lambda roughness: -trials[roughness])
    return [roughness for roughness in order if trials[roughness] > trials[order[0]] - CANDIDATE_MARGIN]


def trial_cost(photos: list[Pixels], step: float) -> float:
    """Seconds that `trial_roughness` takes, from those of one `step` of the full fit; cost is proportional to the pixels shaded."""
    if len(photos) < TRIAL_HOLDOUT:
        return 0.0
    pixels = sum(len(p) for p in photos) / len(photos)
    return len(TRIAL_ROUGHNESS) * TRIAL_STEPS * step * min(1.0, TRIAL_PIXELS / max(1.0, pixels))
