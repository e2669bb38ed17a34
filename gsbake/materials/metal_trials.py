"""Trials of metal and dielectric: groups of texels are turned into the other kind, and validation photos decide.

The search for metals (`metallic`) compares both kinds texel by texel, each at the roughness that suits it best. But a light that was fitted
while a region passed for the wrong kind has adapted to it, and a texel alone has a roughness for every error: gradient steps and searches
in turn stay where they are (coordinate descent in a nonconvex problem). So here groups of similar texels are turned over, texels and light
adapt for a few steps, and only then the two are compared, by the robust error on photos that the fit does not see.

Groups are found by k-means in the space of fitted material and photographed colour. The group's pixels together choose the roughness of
the other kind, and tell by their likelihoods whether a trial is worth its time. First all groups that are likelier as metal are turned at
once, then all that are likelier as dielectric: bands of iron that passed for wood make a light under which none of them does well alone.
Then groups are tried one at a time, also those that are a little less likely as the other kind.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from gsbake.materials.descent import Steps, descend
from gsbake.materials.linear_shading import BaseColourSolver, observed_weight
from gsbake.materials.metallic import TRIED_ROUGHNESS, candidate_model, shaded
from gsbake.materials.passes import Rule, Scene
from gsbake.materials.photo import texel_weight
from gsbake.materials.state import LIMITS, State
from gsbake.materials.surface import Materials
from gsbake.shading.environment import EnvironmentLight

Floats = NDArray[np.float64]

#: Number of groups; those with less than this share of the observed texels have no trial.
GROUPS, MIN_SHARE = 24, 0.008
#: Weight from which a texel is observed.
MIN_WEIGHT = 0.3


@dataclass(frozen=True)
class KindTrialOptions:
    """Constants of the trials of groups."""

    #: What is added to linear colours before their logarithm is taken, and the factor on luminance beside chromaticity in groups.
    log_offset: float = 0.02
    luminance_factor: float = 0.3
    #: Mean log-likelihood ratio per pixel for the present kind up to which a group has a trial.
    max_evidence: float = 2.0
    #: Groups change when that lowers the validation error by the first share, and by the second multiple of their share of the texels, so
    #: by as much of their own error if that is as large as elsewhere; a single one becomes dielectric when the error does not rise: most
    #: things are.
    min_decrease: float = 0.005
    min_own_decrease: float = 0.5
    #: So many trials in a row that changed nothing are the last: the evidence for those that follow is weaker.
    max_refused: int = 4


OPTIONS = KindTrialOptions()


#: A trial: the mean log-likelihood ratio per pixel of a group for its present kind, whether it is to be metal, and its texels (m,).
Trial = tuple[float, bool, NDArray[np.int64]]
Groups = list[NDArray[np.int64]]


@dataclass(frozen=True)
class Turn:
    """Groups that became `metal` or dielectric, their `share` of observed texels, and the relative `decrease` of the validation error."""

    metal: bool
    share: float
    decrease: float

    def __str__(self) -> str:
        return f"{self.share:.1%} of the texels {'metal' if self.metal else 'dielectric'} (error -{self.decrease:.1%})"


@dataclass(frozen=True)
class KindTrials(Rule):
    """Tries groups of texels as the other kind and keeps what validation photos prefer after the gradient `steps` of each trial."""

    steps: Steps

    def applies(self, scene: Scene, state: State) -> bool:
        """With validation photos, on an object that is not diffuse, under a light that stands: metals adapt to the errors of one that
        moves."""
        return state.level.validated and not scene.diffuse and not state.level.moving

    def run(self, scene: Scene, state: State) -> State:
        """The best state, with the evidence."""
        observed = (texel_weight(filter(len, state.level.photos), len(state.values)) > MIN_WEIGHT) & state.emits_nothing
        tried = _Tried.first(scene, state, self.steps)
        models, tries = _candidates(tried.base, observed)
        for metal in (True, False):
            likelier = [group for for_present, other, group in tries if other == metal and for_present < 0]
            if len(likelier) > 1:
                before, tried = tried, tried.with_trial(models, metal, likelier, observed)
                if tried.turns != before.turns:
                    models, tries = _candidates(tried.base, observed)
        refused = 0
        for _, metal, group in tries:
            before, tried = tried, tried.with_trial(models, metal, [group], observed)
            refused = refused + (tried.count > before.count) if tried.turns == before.turns else 0
            if refused == OPTIONS.max_refused:
                break
        found = f"{tried.count} trials of the other kind: {', '.join(map(str, tried.turns)) or 'none kept'}"
        return replace(tried.base, kinds_changed=bool(tried.turns), evidence=f"{state.evidence}; {found}")


@dataclass(frozen=True)
class LightLevel(Rule):
    """Sets the light to the intensity that searches had left, from which gradient steps drift along a valley; where texels changed their
    kind the gradient `steps` search for it again."""

    steps: Steps

    def applies(self, scene: Scene, state: State) -> bool:
        """After trials of kinds, or where they might have been."""
        return not scene.diffuse and not state.level.moving

    def run(self, scene: Scene, state: State) -> State:
        """The light scaled, and base colours so that what they show stays."""
        if state.intensity is not None:
            factor = (state.intensity / np.maximum(state.mean_intensity, 1e-12)).astype(np.float32)
            state = state.under_light(EnvironmentLight.from_radiance(state.radiance * factor), np.flatnonzero(state.emits_nothing))
        if state.kinds_changed:
            state = descend(scene, state, self.steps, scene.each("trials of metal and dielectric"))
        return state


@dataclass(frozen=True)
class _Tried:
    """The best state so far as the `base` of trials, its validation `error` after as many steps as any trial from it, the number of trials
    so far and those that were kept."""

    adapt: Callable[[State], State]
    base: State
    error: float
    count: int = 0
    turns: tuple[Turn, ...] = ()

    @classmethod
    def first(cls, scene: Scene, state: State, steps: Steps) -> _Tried:
        """Before all trials: texels and light adapt once, so that trials are compared with a state that had as many steps."""

        def adapt(state: State) -> State:
            return descend(scene, state, steps, scene.each("trials of metal and dielectric")).judged()

        base = adapt(state)
        return cls(adapt, base.restarted(), adapt(base).error)

    def with_trial(self, models: _Models, metal: bool, groups: Groups, observed: NDArray[np.bool_]) -> _Tried:
        """After a trial of `groups` (m,) of texels as `metal` or dielectric, which is kept where validation photos prefer it."""
        texels, values = [], []
        for group in groups:
            texel = group[self.base.metal[group] != metal]
            colour, roughness = models.best(metal, group, texel)
            texels.append(texel)
            values.append(np.column_stack([colour, np.full(len(texel), roughness)]))
        share = sum(map(len, texels)) / max(1, int(observed.sum()))
        if share < MIN_SHARE:
            return self
        texel, both = np.concatenate(texels), np.concatenate(values).astype(np.float32)
        kind = np.full(len(texel), LIMITS.as_metal if metal else LIMITS.as_dielectric, np.float32)
        changed = self.base.with_inside(texel, Materials(both[:, :3], both[:, 3], kind)).with_transport()
        trial = self.adapt(changed)
        decrease = 1 - trial.error / max(self.error, 1e-12)
        if not decrease > (max(OPTIONS.min_decrease, OPTIONS.min_own_decrease * share) if metal or len(groups) > 1 else 0):
            return replace(self, count=self.count + 1)
        turns = (*self.turns, Turn(metal, share, decrease))
        return replace(self, base=trial.restarted(), error=self.adapt(trial).error, count=self.count + 1, turns=turns)


def _candidates(state: State, observed: NDArray[np.bool_]) -> tuple[_Models, list[Trial]]:
    """The models of all texels under the present light, and the trials that they are worth, those first whose evidence for the other kind
    is strongest."""
    models, tries = _Models(state), list[Trial]()
    for group in _groups(state.materials, state.level.surface.base_color, observed):
        share, for_dielectric = state.metal[group].mean(), models.evidence(group)
        for metal, for_present in ((True, for_dielectric), (False, -for_dielectric)):
            if share != metal and for_present < OPTIONS.max_evidence:
                tries.append((for_present, metal, group))
    return models, sorted(tries, key=lambda entry: entry[0])


class _Models:
    """Dielectric and metallic models of all texels under the present light, at each of a few roughnesses."""

    def __init__(self, state: State) -> None:
        photos, texels = state.metal_samples(), len(state.values)
        self._weight = observed_weight(photos, texels)
        solver, at_each = BaseColourSolver(photos, texels), []
        for tried in TRIED_ROUGHNESS:
            parts = shaded(photos, np.full(texels, tried, np.float32))
            at_each.append([candidate_model(photos, solver, parts, metal) for metal in (False, True)])
        self._found = [*zip(*at_each, strict=True)]

    def _costs(self, metal: bool, group: NDArray[np.int64]) -> list[float]:
        """Negative log-likelihood of all pixels of a `group` (m,) at each roughness."""
        return [float(cost[group].sum()) for cost, *_ in self._found[metal]]

    def evidence(self, group: NDArray[np.int64]) -> float:
        """Mean log-likelihood ratio per pixel of the `group` (m,) for dielectric against metal, at one roughness of each."""
        difference = min(self._costs(True, group)) - min(self._costs(False, group))
        return difference / max(float(self._weight[group].sum()), 1e-6)

    def best(self, metal: bool, group: NDArray[np.int64], texel: NDArray[np.int64]) -> tuple[Floats, float]:
        """Base colours (k, 3) of the texels (k,), and the roughness at which the whole `group` (m,) is explained best."""
        index = int(np.argmin(self._costs(metal, group)))
        return self._found[metal][index][1][texel], TRIED_ROUGHNESS[index]


def _groups(materials: Materials, photographed: NDArray[np.floating], observed: NDArray[np.bool_]) -> Groups:
    """Indices (m,) of the `observed` (n,) texels of each group that is large enough: similar in `materials` and linear `photographed`
    colour (n, 3)."""
    texel = np.flatnonzero(observed)
    columns = [np.column_stack([materials.roughness[texel], materials.metallic[texel]]).astype(np.float64)]
    for colour in (photographed, materials.base_color):
        log = np.log(np.maximum(colour[texel], 0) + OPTIONS.log_offset)
        columns.append(np.column_stack([log[:, 0] - log[:, 1], log[:, 2] - log[:, 1], OPTIONS.luminance_factor * log.mean(1)]))
    points = np.column_stack(columns)
    count = min(GROUPS, len(points))
    if not count:
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of empty groups
        label = kmeans2(points, count, minit="++", rng=np.random.default_rng(0))[1]
    groups = [texel[label == group] for group in range(count)]
    return [group for group in groups if len(group) >= max(1, MIN_SHARE * len(texel))]
