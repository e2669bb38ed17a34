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
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from gsbake.materials.concurrent_fits import Each
from gsbake.materials.fit import MaterialFit
from gsbake.materials.fit_surface import Fitted, validation_error
from gsbake.materials.levels import FitLevel
from gsbake.materials.linear_shading import BaseColourSolver, observed_weight
from gsbake.materials.metallic import TRIED_ROUGHNESS, candidate_model
from gsbake.materials.options import FitSchedule

Floats = NDArray[np.float64]

#: Number of groups; those with less than this share of the observed texels have no trial.
GROUPS, MIN_SHARE = 24, 0.008
#: Weight from which a texel is observed.
MIN_WEIGHT = 0.3
#: What is added to linear colours before their logarithm is taken, and the factor on luminance beside chromaticity in groups.
LOG_OFFSET, LUMINANCE_FACTOR = 0.02, 0.3
#: Mean log-likelihood ratio per pixel for the present kind up to which a group has a trial.
MAX_EVIDENCE = 2.0
#: Groups change when that lowers the validation error by the first share, and by the second multiple of their share of the texels, so by as
#: much of their own error if that is as large as elsewhere; a single one becomes dielectric when the error does not rise: most things are.
MIN_DECREASE, MIN_OWN_DECREASE = 0.005, 0.5

#: A trial: the mean log-likelihood ratio per pixel of a group for its present kind, whether it is to be metal, and its texels (m,).
Trial = tuple[float, bool, NDArray[np.int64]]


@dataclass(frozen=True)
class Turn:
    """Groups that became `metal` or dielectric, their `share` of observed texels, and the relative `decrease` of the validation error."""

    metal: bool
    share: float
    decrease: float

    def __str__(self) -> str:
        return f"{self.share:.1%} of the texels {'metal' if self.metal else 'dielectric'} (error -{self.decrease:.1%})"


@dataclass(frozen=True)
class TrialResult:
    """The fit's result `fitted` after trials, the number of `trials`, and those that were kept, `turned`."""

    fitted: Fitted
    trials: int = 0
    turned: tuple[Turn, ...] = ()

    def __str__(self) -> str:
        return f"{self.trials} trials of the other kind: {', '.join(map(str, self.turned)) or 'none kept'}"


def try_kinds(fit: MaterialFit, fitted: Fitted, level: FitLevel, schedule: FitSchedule, each: Each) -> TrialResult:
    """Try groups of texels as the other kind and keep what validation photos prefer.

    `fit` on the `level`, with the result `fitted`, changes in place; `schedule` has the steps of each trial. Without validation
    photos nothing is tried.
    """
    if not any(map(len, level.held_out)):
        return TrialResult(fitted)
    trial = _Trials(fit, level, schedule, each)
    trial.run((fitted.weight > MIN_WEIGHT) & (fitted.emission.sum(1) == 0))
    return TrialResult(trial.fitted, trial.count, tuple(trial.turned))


class _Trials:
    """Trials one after another: `state` is the best so far, `fitted` its result, after as many steps as any trial from it."""

    def __init__(self, fit: MaterialFit, level: FitLevel, schedule: FitSchedule, each: Each) -> None:
        self.fit, self.level, self.schedule, self.each = fit, level, schedule, each
        self.observed, self.count, self.turned = 0, 0, list[Turn]()
        self._adapt()
        self.state = fit.state()
        self.fitted = self._adapt()

    def _adapt(self) -> Fitted:
        return self.fit.run(self.level.fitted, self.level.held_out, self.schedule, self.each)

    def run(self, observed: NDArray[np.bool_]) -> None:
        """Try the groups of `observed` (n,) texels together and alone, those first whose evidence for the other kind is strongest."""
        self.observed = int(observed.sum())
        models, tries = self._candidates(observed)
        for metal in (True, False):
            likelier = [group for for_present, other, group in tries if other == metal and for_present < 0]
            if len(likelier) > 1 and self._try(models, metal, likelier):
                models, tries = self._candidates(observed)
        for _, metal, group in tries:
            self._try(models, metal, [group])
        self.fit.restore(self.state, self.level.fitted)

    def _candidates(self, observed: NDArray[np.bool_]) -> tuple[_Models, list[Trial]]:
        """The models of all texels under the present light, and the trials that they are worth."""
        self.fit.restore(self.state, self.level.fitted)
        models, tries = _Models(self.fit, self.level), list[Trial]()
        for group in _groups(self.state.values, np.asarray(self.level.surface.base_color), observed):
            share, for_dielectric = (self.state.values[group, 4] > 0.5).mean(), models.evidence(group)
            for metal, for_present in ((True, for_dielectric), (False, -for_dielectric)):
                if share != metal and for_present < MAX_EVIDENCE:
                    tries.append((for_present, metal, group))
        return models, sorted(tries, key=lambda entry: entry[0])

    def _try(self, models: _Models, metal: bool, groups: list[NDArray[np.int64]]) -> bool:
        """Turn `groups` (m,) of texels into `metal` or dielectric and keep that where validation photos prefer it: whether they do."""
        kind, texels, values = self.fit.kind(metal), [], []
        for group in groups:
            texel = group[(self.state.values[group, 4] > 0.5) != metal]
            base, roughness = models.best(metal, group, texel)
            texels.append(texel)
            values.append(np.column_stack([base, np.full(len(texel), roughness), np.full(len(texel), kind)]))
        share = sum(map(len, texels)) / max(1, self.observed)
        if share < MIN_SHARE:
            return False
        self.fit.restore(self.state, self.level.fitted)
        self.fit.set_materials(np.concatenate(texels), np.concatenate(values))
        self.count += 1
        decrease = 1 - validation_error(self._adapt()) / max(validation_error(self.fitted), 1e-12)
        if not decrease > (max(MIN_DECREASE, MIN_OWN_DECREASE * share) if metal or len(groups) > 1 else 0):
            return False
        self.state = self.fit.state()
        self.fitted = self._adapt()
        self.turned.append(Turn(metal, share, decrease))
        return True


class _Models:
    """Dielectric and metallic models of all texels under the present light, at each of a few roughnesses."""

    def __init__(self, fit: MaterialFit, level: FitLevel) -> None:
        photos, texels = fit.metal_samples(level.fitted), len(level.surface.texels)
        self._weight = observed_weight(photos, texels)
        solver, tried = BaseColourSolver(photos, texels), [np.full(texels, r, np.float32) for r in TRIED_ROUGHNESS]
        at_each = [[candidate_model(photos, solver, roughness, metallic) for metallic in (0.0, 1.0)] for roughness in tried]
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


def _groups(values: NDArray[Any], photographed: NDArray[Any], observed: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Indices (m,) of the `observed` (n,) texels of each group that is large enough: similar in material `values` (n, 5) and linear
    `photographed` colour (n, 3)."""
    texel = np.flatnonzero(observed)
    columns = [values[texel, 3:5].astype(np.float64)]
    for colour in (photographed, values[:, :3]):
        log = np.log(np.maximum(colour[texel], 0) + LOG_OFFSET)
        columns.append(np.column_stack([log[:, 0] - log[:, 1], log[:, 2] - log[:, 1], LUMINANCE_FACTOR * log.mean(1)]))
    points = np.column_stack(columns)
    count = min(GROUPS, len(points))
    if not count:
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of empty groups
        label = kmeans2(points, count, minit="++", rng=np.random.default_rng(0))[1]
    groups = [texel[label == group] for group in range(count)]
    return [group for group in groups if len(group) >= max(1, MIN_SHARE * len(texel))]
