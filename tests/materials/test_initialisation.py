"""Choice of the fit's start on fits with known validation PSNR."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from gsbake.materials.initialisation import (
    CANDIDATE_MARGIN,
    DEFAULT_START,
    DIFFUSE_START,
    STARTS,
    ChosenFit,
    Start,
    best_fit,
    candidates,
    trial_fits,
)
from gsbake.materials.options import FitSchedule


class Fit:
    """A fit with the validation PSNR `psnr` that records its schedules."""

    def __init__(self, psnr: float, runs: list[FitSchedule]) -> None:
        self._psnr, self._runs = psnr, runs

    def run(self, photos: Any, held_out: Any, schedule: FitSchedule, each: Any) -> Any:
        self._runs.append(schedule)
        return SimpleNamespace(held_out_psnr=self._psnr if held_out else None)


def level(held_out: bool = True) -> Any:
    return SimpleNamespace(fitted=[[1]], held_out=[[1]] if held_out else [])


def nothing(done: int, total: int) -> None:
    pass


def chosen(trial_scores: dict[Start, float], full_scores: dict[Start, float]) -> tuple[ChosenFit, list[FitSchedule]]:
    runs: list[FitSchedule] = []
    trials: Any = {
        start: (Fit(full_scores.get(start, 0.0), runs), SimpleNamespace(held_out_psnr=score)) for start, score in trial_scores.items()
    }
    return best_fit(trials, level(), FitSchedule(10), nothing), runs


def test_all_starts_are_tried_without_searches_for_the_light() -> None:
    runs: list[FitSchedule] = []
    trials = trial_fits(lambda m, r: Fit(10 * m + r, runs), level(), 7, 1, False, nothing)  # type: ignore[arg-type,return-value]
    assert tuple(trials) == STARTS and len(runs) == len(STARTS)
    assert all(run.iterations == 7 and run.metal_searches_at and not run.intensity and not run.emission for run in runs)
    assert {m > 0.5 for m, _ in STARTS} == {True, False}


@pytest.mark.parametrize(("diffuse", "held_out", "start"), [(True, True, DIFFUSE_START), (False, False, DEFAULT_START)])
def test_one_start_where_nothing_is_compared(diffuse: bool, held_out: bool, start: Start) -> None:
    trials = trial_fits(lambda m, r: Fit(1.0, []), level(held_out), 7, 0, diffuse, nothing)  # type: ignore[arg-type,return-value]
    assert tuple(trials) == (start,)


def test_close_starts_are_continued_and_compared() -> None:
    near = 21.0 - 0.5 * CANDIDATE_MARGIN
    choice, runs = chosen({STARTS[0]: 21.0, STARTS[3]: near, STARTS[1]: 15.0}, {STARTS[0]: 22.0, STARTS[3]: 23.0})
    assert (choice.metallic, choice.roughness) == STARTS[3] and choice.fits == len(runs) == 2
    assert "continued: 22.00 dB" in choice.evidence and "21.00 dB from metallic 0.05 roughness 0.2" in choice.evidence


def test_only_a_clear_winner_is_continued() -> None:
    choice, runs = chosen({STARTS[0]: 21.0, STARTS[1]: 20.9, STARTS[3]: 21.1 + CANDIDATE_MARGIN}, {STARTS[3]: 20.0})
    assert (choice.metallic, choice.roughness) == STARTS[3] and len(runs) == 1


def test_one_candidate_of_either_kind() -> None:
    first, second = candidates({start: 20.0 for start in STARTS})
    assert first[0] < 0.5 < second[0]
