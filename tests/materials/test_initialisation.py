"""Which of several whole fits is kept: told on fits whose score on held-out photos is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.materials.fit import FitSchedule, Fitted
from gsbake.materials.initialisation import DOUBTED, RIVAL, TRIALS, Choice, best_fit, rivals
from gsbake.shading.environment import EnvironmentLight

N = 4
#: Photos only have a length here.
PHOTOS: Any = [range(10)] * 4


@dataclass
class Known:
    """A fit that shows held-out photos to `scores[roughness]` dB, with metals `gain` dB more than without, and `bare` less as it is."""

    roughness: float
    scores: dict[float, float]
    gain: float = 0.0
    bare: float = 0.0
    runs: list[tuple[float, bool]] = field(default_factory=list)
    metals: bool = False

    def run(self, photos: Any, held: Any, schedule: FitSchedule, each: Any = None) -> Fitted:
        metals = schedule.metallic and not schedule.diffuse
        self.metals = metals and self.gain + self.bare != 0
        self.runs.append((self.roughness, metals))
        score = self.scores[self.roughness] + (self.gain if self.metals else 0)
        metal = np.full(N, self.metals)
        values = np.full((N, 5), 0.5, np.float32)
        return Fitted(values, np.zeros((N, 3)), np.ones(N), np.zeros((N, 3)), EnvironmentLight(4), score if held else None, metal, 0, ())

    def psnr(self, photos: Any, values: NDArray[Any]) -> float:
        assert (values[:, 4] == 0).all() and np.allclose(values[:, :3], 0.25)  # without metallic, as bright
        return self.scores[self.roughness] + self.gain - self.bare


def chosen(
    trials: dict[float, float], scores: dict[float, float], held: Any = PHOTOS, matte: bool = False, **known: Any
) -> tuple[Choice, list[tuple[float, bool]]]:
    """What `best_fit` takes, and the whole fits it made as (roughness, metals)."""
    runs: list[tuple[float, bool]] = []
    make: Any = lambda roughness: Known(roughness, scores, runs=runs, **known)  # noqa: E731
    return best_fit(make, PHOTOS, held, 10, 0, trials, matte), runs


def test_close_starts_are_rivals() -> None:
    assert rivals({0.2: 21.0, 0.45: 21.0 + 0.5 * RIVAL, 0.8: 21.0 - 0.6 * RIVAL}) == [0.45, 0.2]
    assert rivals({}) == []


def test_held_out_photos_choose_between_rivals() -> None:
    choice, runs = chosen({0.2: 21.0, 0.45: 20.5, 0.8: 15.0}, {0.2: 22.0, 0.45: 23.0})
    assert choice.roughness == 0.45 and runs == [(0.2, True), (0.45, True)] and choice.fits == 2
    assert "fitted in full 22.00 dB from 0.2, 23.00 dB from 0.45" in choice.why and choice.metals is None
    choice, runs = chosen({0.2: 21.0, 0.45: 20.5}, {0.2: 22.0, 0.45: 23.0}, held=[])
    assert choice.roughness == 0.2 and runs == [(0.2, True)]  # nobody to judge


@pytest.mark.parametrize(("matte", "start"), [(True, TRIALS[-1]), (False, TRIALS[1])])
def test_without_trials(matte: bool, start: float) -> None:
    choice, runs = chosen({}, {start: 30.0}, matte=matte)
    assert choice.roughness == start and runs == [(start, not matte)]


def test_metals_that_photos_need_are_not_doubted() -> None:
    choice, runs = chosen({0.2: 21.0}, {0.2: 22.0}, gain=1.0, bare=DOUBTED + 0.1)
    assert choice.fitted.metal.all() and choice.fits == 1 and choice.metals is None


@pytest.mark.parametrize(("gain", "stay"), [(0.2, True), (-0.2, False)])
def test_doubted_metals_stay_where_a_fit_without_is_worse(gain: float, stay: bool) -> None:
    choice, runs = chosen({0.2: 21.0}, {0.2: 22.0}, gain=gain, bare=DOUBTED - 0.1)
    assert runs == [(0.2, True), (0.2, False)] and choice.fits == 2
    assert choice.fitted.metal.all() == stay and choice.metals is not None
    assert f"{22 + gain:.2f} dB with them, fitted without to 22.00 dB" in choice.metals
