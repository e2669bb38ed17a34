"""The schedule of the material fit over two resolutions: trials, searches, and refinement.

Short trials from several starts and the continued fit with all searches (light, metals, emissive regions) run on the coarse level, where a
step costs a quarter. The fine level continues from the result for a few steps: it sharpens base colours and the edges of metals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from gsbake.materials.concurrent_fits import Each, run_concurrently
from gsbake.materials.fit import MaterialFit
from gsbake.materials.fit_surface import validation_error
from gsbake.materials.initialisation import DEFAULT_START, ChosenFit, best_fit, compared_starts, trial_fits, trial_schedule
from gsbake.materials.levels import FitLevel
from gsbake.materials.metal_trials import try_kinds
from gsbake.materials.options import FitSchedule, Priors
from gsbake.shading.light_motion import Motion
from gsbake.texturing.resampling import CoarseTexture

#: Steps of a trial, of the continued fit on the coarse level, and on the fine one, as shares of the iterations.
TRIAL_SHARE, COARSE_SHARE, FINE_SHARE = 0.25, 0.5, 0.25
#: How often the noise of metals' base colours is removed on the coarse level, and the steps after each, as after each trial of another kind
#: for a group of texels, in which texels and light adapt, as a share of the iterations, with their factor on the learning rates: noise of
#: single photos does not decide.
NOISE_ROUNDS, ADAPT_SHARE, ADAPT_RATE = 2, 0.15, 0.3
#: How often shading left in base colours is moved to the light at the end of the coarse level, where most is dielectric and the light
#: stands, and the steps after each, as a share of the iterations, in which texels adapt to it, with their factor on the learning rates.
#: From there the light is given: gradient steps would move it back, as that base colours have no shading is not part of their loss.
SHADING_ROUNDS, SHADING_SHARE, SHADING_RATE = 4, 0.05, 0.5
#: When metals are searched for on the fine level, as a share of its steps.
FINE_METAL_SEARCHES_AT = (0.3,)

#: Called after every step with what is being done, the number of steps done and their total.
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class FitPlan:
    """`iterations` in all of one candidate; `light_size` edge of the environment map's faces in texels; `diffuse`: without specular
    reflection."""

    iterations: int
    light_size: int
    priors: Priors
    seed: int = 0
    diffuse: bool = False

    def steps(self, share: float) -> int:
        """Steps of a share of the iterations; at least one."""
        return max(1, round(share * self.iterations))


def compare_light_motions(levels: Mapping[Motion, FitLevel], plan: FitPlan, progress: Progress) -> dict[Motion, float]:
    """Validation error of short fits from the default start on the coarse `levels`, whose photos differ in how the light moves.

    Metals are not searched for: that takes longer than the fits, and has not changed which light fits better.
    """
    steps, (metallic, roughness) = plan.steps(TRIAL_SHARE), DEFAULT_START
    schedule = replace(trial_schedule(steps, plan.seed, plan.diffuse), metal_searches_at=())

    def run(level: FitLevel, each: Each) -> float:
        fit = MaterialFit(level.surface, plan.light_size, plan.priors, roughness, metallic)
        return validation_error(fit.run(level.fitted, level.held_out, schedule, each))

    errors = run_concurrently([partial(run, level) for level in levels.values()], partial(progress, "trial fits of moving lights"))
    return dict(zip(levels, errors, strict=True))


def _with_better_metals(choice: ChosenFit, level: FitLevel, plan: FitPlan, each: Each) -> ChosenFit:
    """The choice after metals' base colours had their noise removed, to which the light adapted, with those groups of texels turned into
    the other kind that validation photos prefer as such; where there are any, the light's intensity is searched for again."""
    quiet = FitSchedule(plan.steps(ADAPT_SHARE), plan.seed, (), emission=False, light_searches_at=(), sparsity=False, normals=False)
    steps, intensity = replace(quiet, rate=ADAPT_RATE), choice.fit.light_intensity()
    for turn in range(NOISE_ROUNDS):
        choice.fit.remove_noise(level.fitted)
        choice = replace(choice, fitted=choice.fit.run(level.fitted, level.held_out, replace(steps, seed=plan.seed + turn), each))
    found = try_kinds(choice.fit, choice.fitted, level, steps, each)
    choice.fit.set_light_intensity(intensity)  # gradient steps drift along the valley that the search had left
    fitted = found.fitted
    if found.turned:
        fitted = choice.fit.run(level.fitted, level.held_out, replace(steps, light_searches_at=(0.0,)), each)
    return replace(choice, fitted=fitted, evidence=f"{choice.evidence}; {found}")


def fit_two_levels(coarse: FitLevel, fine: FitLevel, texture: CoarseTexture, plan: FitPlan, progress: Progress) -> ChosenFit:
    """The fit on the `fine` level, whose texels `texture` reduces to those of `coarse`."""
    steps = plan.steps

    def each(name: str) -> Each:
        return lambda done, total: progress(name, done, total)

    def make(metallic: float, roughness: float) -> MaterialFit:
        return MaterialFit(coarse.surface, plan.light_size, plan.priors, roughness, metallic)

    trial = trial_schedule(steps(TRIAL_SHARE), plan.seed, plan.diffuse)
    starts, reason = compared_starts(make, coarse, trial, each("trial fits"))
    trials = trial_fits(make, coarse, starts, trial, each("trial fits"))
    schedule = FitSchedule(steps(COARSE_SHARE), plan.seed, diffuse=plan.diffuse, normals=False)
    choice = best_fit(trials, coarse, schedule, each("material fit, coarse level"), reason)
    # Metals adapt to the errors of a moving light, which is an approximation, and changes of metals to theirs.
    metals = not (plan.diffuse or choice.fit.moving_light)
    if metals:
        choice = _with_better_metals(choice, coarse, plan, each("trials of metal and dielectric"))
    refine = FitSchedule(steps(FINE_SHARE), plan.seed, FINE_METAL_SEARCHES_AT, emission=False, light_searches_at=(), diffuse=plan.diffuse)
    if choice.fit.mostly_dielectric and not choice.fit.moving_light:
        refine = replace(refine, fixed_light=True)
        adapt = replace(refine, iterations=steps(SHADING_SHARE), metal_searches_at=(), rate=SHADING_RATE)
        for turn in range(SHADING_ROUNDS + 1):
            if turn:
                choice.fit.run(coarse.fitted, [], adapt, each("remaining shading"))
            seed = plan.seed + turn
            choice.fit.move_to_light(choice.fit.find_remaining_shading(seed), seed)
    if not choice.fit.mostly_dielectric:
        choice.fit.rescale_metallic()
    fit = choice.fit.continued_on(fine.surface, texture.up)
    if metals:
        fit.remove_noise(fine.fitted)
    fitted = fit.run(fine.fitted, fine.held_out, refine, each("material fit, fine level"))
    if metals:
        fit.remove_noise(fine.fitted)
        fitted = fit.run(fine.fitted, fine.held_out, replace(refine, iterations=0))
    return replace(choice, fit=fit, fitted=fitted)
