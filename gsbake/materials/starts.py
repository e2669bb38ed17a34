"""Start of the material fit: how the light moves, and initial metallic and roughness, compared on validation photos.

Gradient steps find the optimum near their start. A surface that starts too rough cannot localise light, and its reflections end up in base
colour; one that starts dielectric explains a metal's reflections by a diffuse base colour under a light of their colour, and stays there.
So fits on the coarsest level, from all-dielectric and all-metal starts of several roughnesses, are compared on photos that they were not
fitted to. None is left out early: a smooth light fits in a few steps, and the sharp one that glaze calls for in hundreds, so that
after few steps the roughest start is ahead on smooth objects too. On the way texels are decided one by one between metal and
dielectric, so either start can end as any mixture. What is used is the start that won: the fit itself starts there anew, on a finer level.

They are compared by a robust error: a sharp reflection a few pixels off counts twice in the squared error, where it is and where it should
be, so that the PSNR prefers materials that are too rough. Fits that started with another roughness often explain the photos as well, by a
brighter or a dimmer light: there its prior decides (`intensity_prior`), but not between metal and dielectric. Where both kinds explain the
photos, the object is dielectric, as most are.

A capture too small for validation photos distinguishes metals from dielectrics all the same, but not the roughness of dielectrics: every
fourth photo is held out while the best starts of the two kinds are compared, and all are fitted from the start that is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from gsbake.capture.photos.roles import held_out
from gsbake.materials.concurrent_fits import Each, run_concurrently
from gsbake.materials.descent import Steps, descend
from gsbake.materials.light_intensity import OBSERVATIONS
from gsbake.materials.passes import Rule, Scene
from gsbake.materials.remaining_shading import moved_to_light, shading_of
from gsbake.materials.state import Level, State
from gsbake.shading.light_motion import LightMotion, Motion

Key = TypeVar("Key")
#: Initial metallic and roughness.
Start = tuple[float, float]
#: States by their start.
Trials = dict[Start, State]

#: What a light does, in words.
MOTIONS: dict[Motion, str] = {
    "static": "stands", "turntable": "turns with the cameras (turntable)", "camera": "moves with the camera",
}  # fmt: skip


@dataclass(frozen=True)
class StartComparison(Rule):
    """Fits from several starts by the `steps`, and the best of them."""

    steps: Steps
    #: Compared starts: metallic and roughness.
    dielectric_starts: tuple[Start, ...] = ((0.05, 0.12), (0.05, 0.25), (0.05, 0.45), (0.05, 0.8))
    metal_starts: tuple[Start, ...] = ((0.9, 0.2), (0.9, 0.45))
    #: Start of a diffuse object, and without validation photos.
    diffuse_start: Start = (0.05, 0.8)
    default_start: Start = (0.05, 0.45)
    #: Without validation photos every so many photos are held out while metal is compared with dielectric.
    kind_holdout: int = 4
    #: A metallic start must have less error than the best dielectric one, by this share; by more where the light moves, as such a light is
    #: an approximation, to whose errors rough metal adapts.
    metal_margin: float = 0.04
    moving_metal_margin: float = 0.1

    @property
    def starts(self) -> tuple[Start, ...]:
        """All starts."""
        return self.dielectric_starts + self.metal_starts

    def run(self, scene: Scene, state: State) -> State:
        """The same with the chosen start and the evidence."""

        def tried(level: Level, starts: Sequence[Start]) -> Trials:
            return descend_all(started(scene, level, starts), self.steps, scene, "trial fits")

        starts, reason = self.compared(state.level, scene.diffuse, tried)
        if len(starts) == 1:
            return replace(state, chosen_start=starts[0], evidence=reason)
        best = self.best(tried(state.level, starts))
        return replace(state, chosen_start=best.chosen_start, evidence=best.evidence)

    def compared(self, level: Level, diffuse: bool, tried: Callable[[Level, Sequence[Start]], Trials]) -> tuple[tuple[Start, ...], str]:
        """The starts to compare, and why, where that is one: of a diffuse object, or without validation photos."""
        if diffuse:
            return (self.diffuse_start,), "diffuse object"
        if level.validated or len(self.starts) == 1:
            return self.starts, ""
        apart = set(held_out(len(level.photos), self.kind_holdout))
        if not apart:
            return (self.default_start,), "no validation photos"
        kept, chosen = ([photo for i, photo in enumerate(level.photos) if (i in apart) == role] for role in (False, True))
        trials = tried(replace(level, photos=kept, validation=chosen), self.starts)
        errors = {start: state.error for start, state in trials.items()}
        metal, dielectric = (min(kind, key=lambda start: errors[start]) for kind in (self.metal_starts, self.dielectric_starts))
        clear = errors[metal] < (1 - self._margin(level)) * errors[dielectric]
        reason = f"no validation photos; by every {self.kind_holdout}th photo, fitted afterwards: {_percent(errors)}"
        return (metal if clear else self.default_start,), reason

    def best(self, trials: Trials) -> State:
        """The state with the least validation error of the `trials`, with the evidence."""
        errors = {start: state.error for start, state in trials.items()}
        weighed = {start: error * _prior_factor(trials[start]) for start, error in errors.items()}
        kinds = [[start for start in weighed if (start in self.metal_starts) == metal] for metal in (False, True)]
        finalists = [min(kind, key=lambda start: weighed[start]) for kind in kinds if kind]
        margin = self._margin(next(iter(trials.values())).level)
        best = min(finalists, key=lambda start: errors[start] * (1 if start in self.metal_starts else 1 - margin))
        return replace(trials[best], chosen_start=best, evidence=f"{_percent(errors)}; with the prior of the light: {_percent(weighed)}")

    def _margin(self, level: Level) -> float:
        """Share by which a metallic start must have less error than a dielectric one."""
        return self.moving_metal_margin if level.moving else self.metal_margin


@dataclass(frozen=True)
class MotionComparison(Rule):
    """How the light moves, by short fits to photos under lights that move differently, from the `start`, by the `trial` steps. Where one
    that moves wins, both are continued by the `full` steps, and it must win again: it explains photos sooner, and often not better.

    Metals are not searched for in trials: that takes longer than the fits, and has not changed which light fits better."""

    trial: Steps
    full: Steps
    start: Start = (0.05, 0.45)
    #: A light is taken to turn, or to move with the camera, where that lowers the validation error by these shares, both times. A turntable
    #: lowered it by .12 and .14, a flash by .38 and .51; lights that stood, on a plain mug by .19 and .15, on a bowl by .27 and not at all.
    #: Where a flash fired the lower bound does.
    least_turntable_gain: float = 0.08
    least_camera_gain: float = 0.22
    least_flash_gain: float = 0.08

    def applies(self, scene: Scene, state: State) -> bool:
        """Where there are motions to choose from, and reflections and validation photos to choose by."""
        return len(scene.motions) > 1 and not scene.diffuse and state.level.validated

    def run(self, scene: Scene, state: State) -> State:
        """The same under the light that explains the validation photos best."""
        levels = {motion: state.level.under(rotations) for motion, rotations in scene.motions.items()}
        fits = {motion: started(scene, level, [self.start])[self.start] for motion, level in levels.items()}
        fits = descend_all(fits, self.trial, scene, "trial fits of moving lights")
        best, evidence = self._best(fits, scene), _errors(fits)
        if best != "static":
            fits = descend_all({motion: fits[motion] for motion in ("static", best)}, self.full, scene, "trial fits of moving lights")
            best, evidence = self._best(fits, scene), f"{evidence}; continued: {_errors(fits)}"
        scene.decide("light", MOTIONS[best], evidence)
        return replace(state, level=levels[best], light_motion=LightMotion(best, scene.motions[best]))

    def _best(self, fits: Mapping[Motion, State], scene: Scene) -> Motion:
        """The motion with the least error, where it gains enough."""
        camera = self.least_flash_gain if scene.flash else self.least_camera_gain
        gains: dict[Motion, float] = {"static": 0.0, "turntable": self.least_turntable_gain, "camera": camera}
        return min(fits, key=lambda motion: fits[motion].error / (1 - gains[motion]))


@dataclass(frozen=True)
class ChosenStart(Rule):
    """Starts anew on the next finer level, from the start that was chosen on this one."""

    def run(self, scene: Scene, state: State) -> State:
        """The start there."""
        assert state.level.finer is not None
        level = state.level.finer.level.under(state.light_motion.rotations)
        (start,) = started(scene, level, (state.chosen_start,)).values()
        return replace(start, chosen_start=state.chosen_start, evidence=state.evidence, light_motion=state.light_motion)


def started(scene: Scene, level: Level, starts: Sequence[Start]) -> Trials:
    """States from `starts` on the `level`. Those that start dielectric, under a light that stands, start without the shading in the
    projected colours."""
    fits, shading = Trials(), None
    for metallic, roughness in starts:
        state = State.start(level, scene.light_size, roughness, metallic)
        if not level.moving and state.mostly_dielectric:
            shading = shading_of(state, scene.seed) if shading is None else shading  # the same from every start
            state = moved_to_light(state, shading, scene.seed)
        fits[metallic, roughness] = state
    return fits


def descend_all(states: Mapping[Key, State], steps: Steps, scene: Scene, name: str) -> dict[Key, State]:
    """The `states` after gradient `steps`, several at a time, judged on validation photos."""

    def fit(state: State, each: Each) -> State:
        return descend(scene, state, steps, each).judged()

    found = run_concurrently([partial(fit, state) for state in states.values()], scene.each(name))
    return dict(zip(states, found, strict=True))


def _prior_factor(state: State) -> float:
    """Factor on the error of a fit by the prior of its light's intensity, as in the search for that; 1 where the light moves."""
    return 1.0 if state.level.moving else math.exp(state.intensity_prior.negative_log(1) / OBSERVATIONS)


def _errors(fits: Mapping[Motion, State]) -> str:
    """Errors in percent of white."""
    return ", ".join(f"{fit.error:.2%} error where it {MOTIONS[motion]}" for motion, fit in fits.items())


def _percent(errors: Mapping[Start, float]) -> str:
    """Errors in percent of white."""
    return ", ".join(f"{error:.2%} error from metallic {m:g} roughness {r:g}" for (m, r), error in errors.items())
