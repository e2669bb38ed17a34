"""Choice of the initial roughness and validation of metals, on fits with known held-out PSNR."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.materials.fit import Fitted
from gsbake.materials.initialisation import CANDIDATE_MARGIN, METAL_MARGIN, TRIAL_ROUGHNESS, ChosenFit, best_fit, roughness_candidates
from gsbake.materials.options import FitSchedule
from gsbake.shading.environment import EnvironmentLight

N = 4
#: Stand-ins for photos; only their length is used.
PHOTOS: Any = [range(10)] * 4


@dataclass
class KnownFit:
    """A fit with held-out PSNR `scores[roughness]`, `gain` dB more with metals, and `loss` dB less with metallic set to 0."""

    roughness: float
    scores: dict[float, float]
    gain: float = 0.0
    loss: float = 0.0
    runs: list[tuple[float, bool]] = field(default_factory=list)
    metals: bool = False

    def run(self, photos: Any, held: Any, schedule: FitSchedule, each: Any = None) -> Fitted:
        metals = schedule.metallic and not schedule.diffuse
        self.metals = metals and self.gain + self.loss != 0
        self.runs.append((self.roughness, metals))
        score = self.scores[self.roughness] + (self.gain if self.metals else 0)
        metal = np.full(N, self.metals)
        values = np.full((N, 5), 0.5, np.float32)
        return Fitted(values, np.zeros((N, 3)), np.ones(N), np.zeros((N, 3)), EnvironmentLight(4), score if held else None, metal, 0, ())

    def psnr(self, photos: Any, values: NDArray[Any]) -> float:
        assert (values[:, 4] == 0).all() and np.allclose(values[:, :3], 0.25)  # metallic 0, same diffuse reflectance
        return self.scores[self.roughness] + self.gain - self.loss


def chosen(
    trials: dict[float, float], scores: dict[float, float], held: Any = PHOTOS, diffuse: bool = False, **known: Any
) -> tuple[ChosenFit, list[tuple[float, bool]]]:
    """The result of `best_fit`, and the full fits made as (roughness, metals)."""
    runs: list[tuple[float, bool]] = []
    make: Any = lambda roughness: KnownFit(roughness, scores, runs=runs, **known)  # noqa: E731
    return best_fit(make, PHOTOS, held, 10, 0, trials, diffuse), runs


def test_close_trials_are_candidates() -> None:
    assert roughness_candidates({0.2: 21.0, 0.45: 21.0 + 0.5 * CANDIDATE_MARGIN, 0.8: 21.0 - 0.6 * CANDIDATE_MARGIN}) == [0.45, 0.2]
    assert roughness_candidates({}) == []


def test_held_out_photos_choose_between_candidates() -> None:
    choice, runs = chosen({0.2: 21.0, 0.45: 20.5, 0.8: 15.0}, {0.2: 22.0, 0.45: 23.0})
    assert choice.roughness == 0.45 and runs == [(0.2, True), (0.45, True)] and choice.fits == 2
    assert "full fits: 22.00 dB from 0.2, 23.00 dB from 0.45" in choice.evidence and choice.metal_evidence is None
    choice, runs = chosen({0.2: 21.0, 0.45: 20.5}, {0.2: 22.0, 0.45: 23.0}, held=[])
    assert choice.roughness == 0.2 and runs == [(0.2, True)]  # no validation


@pytest.mark.parametrize(("diffuse", "start"), [(True, TRIAL_ROUGHNESS[-1]), (False, TRIAL_ROUGHNESS[1])])
def test_without_trials(diffuse: bool, start: float) -> None:
    choice, runs = chosen({}, {start: 30.0}, diffuse=diffuse)
    assert choice.roughness == start and runs == [(start, not diffuse)]


def test_metals_with_clear_gain_are_accepted() -> None:
    choice, runs = chosen({0.2: 21.0}, {0.2: 22.0}, gain=1.0, loss=METAL_MARGIN + 0.1)
    assert choice.fitted.metal.all() and choice.fits == 1 and choice.metal_evidence is None


@pytest.mark.parametrize(("gain", "accepted"), [(0.2, True), (-0.2, False)])
def test_metals_are_rejected_where_a_fit_without_is_better(gain: float, accepted: bool) -> None:
    choice, runs = chosen({0.2: 21.0}, {0.2: 22.0}, gain=gain, loss=METAL_MARGIN - 0.1)
    assert runs == [(0.2, True), (0.2, False)] and choice.fits == 2
    assert choice.fitted.metal.all() == accepted and choice.metal_evidence is not None
    assert f"{22 + gain:.2f} dB with metals, 22.00 dB fitted without" in choice.metal_evidence
