"""Choice of the fit's start on fits with known validation error."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from gsbake.materials.initialisation import (
    CANDIDATE_FACTOR,
    DEFAULT_START,
    DIFFUSE_START,
    KIND_HOLDOUT,
    MAX_CANDIDATES,
    METAL_MARGIN,
    METAL_STARTS,
    MOVING_METAL_MARGIN,
    STARTS,
    ChosenFit,
    Start,
    best_fit,
    candidates,
    compared_starts,
    trial_fits,
    trial_schedule,
)
from gsbake.materials.intensity_prior import RADIANCE, IntensityPrior
from gsbake.materials.levels import FitLevel
from gsbake.materials.options import FitSchedule


class Fit:
    """A fit with the validation error `error` under a light of mean `radiance` that records its schedules, and whether shading was removed
    before the first."""

    def __init__(
        self, error: float, runs: list[FitSchedule], mostly_dielectric: bool = True, radiance: float = RADIANCE[0]
    ) -> None:  # fmt: skip
        self._error, self._runs, self.mostly_dielectric, self.without_shading = error, runs, mostly_dielectric, False
        self._radiance = radiance

    moving_light = False

    def intensity_prior(self) -> IntensityPrior:
        return IntensityPrior(radiance=self._radiance)

    def find_remaining_shading(self, seed: int) -> float:
        return 3.0 + seed

    def move_to_light(self, shading: float, seed: int) -> None:
        self.without_shading = shading == self.find_remaining_shading(seed)

    def run(self, photos: Any, held_out: Any, schedule: FitSchedule, each: Any) -> Any:
        self._runs.append(schedule)
        return SimpleNamespace(held_out_loss=self._error if held_out else None)


class Photo:
    """Pixels of one photo under a light that is turned `to_light`."""

    def __init__(self, to_light: Any = None) -> None:
        self.to_light = to_light

    def __len__(self) -> int:
        return 1


def level(held_out: bool = True, to_light: Any = None, photos: int = 1) -> FitLevel:
    fitted: Any = [Photo(to_light) for _ in range(photos)]
    surface: Any = None
    return FitLevel(surface, fitted, [fitted[0]] if held_out else [])


def nothing(done: int, total: int) -> None:
    pass


def chosen(
    trial_errors: dict[Start, float], full_errors: dict[Start, float], radiance: dict[Start, float] | None = None
) -> tuple[ChosenFit, list[FitSchedule]]:
    runs: list[FitSchedule] = []
    trials: Any = {
        start: (
            Fit(full_errors.get(start, 1.0), runs, radiance=(radiance or {}).get(start, RADIANCE[0])),
            SimpleNamespace(held_out_loss=error),
        )
        for start, error in trial_errors.items()
    }
    return best_fit(trials, level(), FitSchedule(10), nothing), runs


def test_all_starts_are_tried_without_searches_for_the_light() -> None:
    runs: list[FitSchedule] = []
    make: Any = lambda m, r: Fit(10 * m + r, runs)  # noqa: E731
    starts, reason = compared_starts(make, level(), trial_schedule(7, 1, False), nothing)
    trials = trial_fits(make, level(), starts, trial_schedule(7, 1, False), nothing)
    assert tuple(trials) == starts == STARTS and len(runs) == len(STARTS) and not reason
    assert all(run.iterations == 7 and run.metal_searches_at and not run.light_searches_at and not run.emission for run in runs)
    assert {m > 0.5 for m, _ in STARTS} == {True, False} and all(m > 0.5 for m, _ in METAL_STARTS)


@pytest.mark.parametrize("moves", [False, True])
def test_dielectric_starts_have_no_shading_where_the_light_stands(moves: bool) -> None:
    make: Any = lambda m, r: Fit(1.0, [], m < 0.5)  # noqa: E731
    plan = trial_schedule(7, 0, False)
    trials: Any = trial_fits(make, level(to_light="turned" if moves else None), STARTS, plan, nothing)
    assert [fit.without_shading for fit, _ in trials.values()] == [metallic < 0.5 and not moves for metallic, _ in STARTS]


@pytest.mark.parametrize(
    ("diffuse", "held_out", "photos", "start"),
    [(True, True, 40, DIFFUSE_START), (True, False, 40, DIFFUSE_START), (False, False, 6, DEFAULT_START)],
)
def test_one_start_where_nothing_is_compared(diffuse: bool, held_out: bool, photos: int, start: Start) -> None:
    runs: list[FitSchedule] = []
    make: Any = lambda m, r: Fit(1.0, runs)  # noqa: E731
    starts, reason = compared_starts(make, level(held_out, photos=photos), trial_schedule(7, 0, diffuse), nothing)
    assert starts == (start,) and not runs and reason


def kind_by_few_photos(metal_error: float, moves: bool = False, smooth_error: float = 1.2) -> tuple[Start, list[tuple[int, int]]]:
    """The start chosen without validation photos, where metal of roughness .45 has `metal_error`, the default dielectric 1 and a smooth one
    `smooth_error`, with the number of photos that each trial was fitted to and compared on."""
    counts: list[tuple[int, int]] = []

    class Counted(Fit):
        moving_light = moves

        def run(self, photos: Any, held_out: Any, schedule: FitSchedule, each: Any) -> Any:
            assert not {*map(id, photos)} & {*map(id, held_out)}
            counts.append((len(photos), len(held_out)))
            return super().run(photos, held_out, schedule, each)

    errors = {STARTS[0]: smooth_error, DEFAULT_START: 1.0, STARTS[2]: 1.4, METAL_STARTS[0]: 1.5, METAL_STARTS[1]: metal_error}
    make: Any = lambda m, r: Counted(errors[m, r], [], m < 0.5)  # noqa: E731
    (start,), reason = compared_starts(make, level(False, photos=11), trial_schedule(7, 0, False), nothing)
    assert "100.00% error from metallic 0.05" in reason
    return start, counts


def test_few_photos_distinguish_metal_from_dielectric_by_photos_held_out() -> None:
    start, counts = kind_by_few_photos(1 - 2 * METAL_MARGIN)
    assert start == METAL_STARTS[1] and counts == len(STARTS) * [(8, 3)] and KIND_HOLDOUT == 4
    assert kind_by_few_photos(1 - METAL_MARGIN / 2)[0] == DEFAULT_START  # not clearly better
    assert kind_by_few_photos(0.9, smooth_error=0.9)[0] == DEFAULT_START  # than the best dielectric one
    assert kind_by_few_photos(1 - 2 * METAL_MARGIN, moves=True)[0] == DEFAULT_START
    assert kind_by_few_photos(1 - 2 * MOVING_METAL_MARGIN, moves=True)[0] == METAL_STARTS[1]


def test_close_starts_are_continued_and_compared() -> None:
    near = 0.02 * (1 + CANDIDATE_FACTOR) / 2
    choice, runs = chosen({STARTS[0]: 0.02, STARTS[3]: near, STARTS[1]: 0.05}, {STARTS[0]: 0.018, STARTS[3]: 0.01})
    assert (choice.metallic, choice.roughness) == STARTS[3] and choice.fits == len(runs) == 2
    assert "continued: 1.80% error" in choice.evidence and "2.00% error from metallic 0.05 roughness 0.2" in choice.evidence


def test_only_a_clear_winner_is_continued() -> None:
    choice, runs = chosen({STARTS[0]: 0.021, STARTS[1]: 0.022, STARTS[3]: 0.02 / CANDIDATE_FACTOR}, {STARTS[3]: 0.3})
    assert (choice.metallic, choice.roughness) == STARTS[3] and len(runs) == 1


def test_a_metal_must_be_clearly_better() -> None:
    trials = {STARTS[0]: 0.02, STARTS[3]: 0.02}
    assert chosen(trials, {STARTS[0]: 0.02, STARTS[3]: 0.02 * (1 - METAL_MARGIN / 2)})[0].metallic < 0.5
    assert chosen(trials, {STARTS[0]: 0.02, STARTS[3]: 0.02 * (1 - METAL_MARGIN * 2)})[0].metallic > 0.5


def test_a_metal_under_a_moving_light_must_be_better_still(monkeypatch: pytest.MonkeyPatch) -> None:
    trials, errors = {STARTS[0]: 0.02, STARTS[3]: 0.02}, {STARTS[0]: 0.02, STARTS[3]: 0.02 * (1 - METAL_MARGIN * 2)}
    monkeypatch.setattr(Fit, "moving_light", True)
    assert chosen(trials, errors)[0].metallic < 0.5
    assert chosen(trials, errors | {STARTS[3]: 0.02 * (1 - MOVING_METAL_MARGIN * 1.1)})[0].metallic > 0.5


def test_the_prior_of_the_light_decides_between_equal_fits() -> None:
    """A light three times as bright as usual loses by little error and wins by much."""
    trials, bright = {STARTS[0]: 0.02, STARTS[1]: 0.02}, {STARTS[0]: 3 * RADIANCE[0]}
    assert chosen(trials, {STARTS[0]: 0.02, STARTS[1]: 0.0202}, bright)[0].roughness == STARTS[1][1]
    assert chosen(trials, {STARTS[0]: 0.014, STARTS[1]: 0.0202}, bright)[0].roughness == STARTS[0][1]
    kinds = {STARTS[0]: 0.02, STARTS[3]: 0.02}
    assert chosen(kinds, {STARTS[0]: 0.02, STARTS[3]: 0.0202}, bright)[0].metallic < 0.5  # not between metal and dielectric


def test_the_number_of_candidates_is_bounded() -> None:
    errors = {start: 0.02 + 1e-4 * k for k, start in enumerate(STARTS)}
    assert candidates(errors) == list(STARTS[:MAX_CANDIDATES])
