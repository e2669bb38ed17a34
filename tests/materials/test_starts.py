"""Choice of the fit's start on fits with known validation error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from gsbake.materials import starts as starts_module
from gsbake.materials.light_intensity import RADIANCE, IntensityPrior
from gsbake.materials.passes import Scene
from gsbake.materials.recipe import START
from gsbake.materials.starts import Start, StartComparison, Trials, started
from gsbake.materials.state import Level
from tests.materials.test_fit import WEAK_PRIORS, Sphere

COMPARISON = StartComparison(START)
STARTS, METAL_STARTS = COMPARISON.starts, COMPARISON.metal_starts
DIELECTRIC, OTHER, METAL = STARTS[0], STARTS[1], METAL_STARTS[0]
METAL_MARGIN, MOVING_METAL_MARGIN = COMPARISON.metal_margin, COMPARISON.moving_metal_margin


@dataclass(frozen=True)
class Light:
    """A light that stands or moves."""

    moving: bool = False


@dataclass(frozen=True)
class Fit:
    """A fit with the validation `error` under a light of mean `radiance`."""

    error: float
    radiance: float = RADIANCE[0]
    level: Light = Light()
    chosen_start: Start = (0.0, 0.0)
    evidence: str = ""

    @property
    def intensity_prior(self) -> IntensityPrior:
        return IntensityPrior(radiance=self.radiance)


class Photo:
    """Pixels of one photo under a light that is turned `to_light`."""

    def __init__(self, to_light: Any = None) -> None:
        self.to_light = to_light

    def __len__(self) -> int:
        return 1


def level(held_out: bool = True, photos: int = 1, to_light: Any = None) -> Level:
    fitted: Any = [Photo(to_light) for _ in range(photos)]
    surface: Any = None
    return Level(surface, fitted, [fitted[0]] if held_out else [])


def chosen(errors: dict[Start, float], radiance: dict[Start, float] | None = None, moving: bool = False) -> Any:
    """The chosen fit of those with these errors."""
    light = radiance or {}
    trials: Any = {start: Fit(error, light.get(start, RADIANCE[0]), Light(moving)) for start, error in errors.items()}
    return COMPARISON.best(trials)


def never(level: Level, starts: Sequence[Start]) -> Trials:
    raise AssertionError("nothing is tried")


def test_all_starts_are_tried() -> None:
    assert COMPARISON.compared(level(), False, never) == (STARTS, "")
    assert not START.sparsity and not START.normals
    assert {m > 0.5 for m, _ in STARTS} == {True, False} and all(m > 0.5 for m, _ in METAL_STARTS)


@pytest.mark.parametrize("moves", [False, True])
def test_dielectric_starts_have_no_shading_where_the_light_stands(moves: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, moved, searched = Sphere(0.25, 2), [], []
    photos = [replace(photo, to_light=np.eye(3)) for photo in scene.photos] if moves else scene.photos
    monkeypatch.setattr(starts_module, "shading_of", lambda state, seed: searched.append(seed))
    monkeypatch.setattr(starts_module, "moved_to_light", lambda state, *_: moved.append(state.materials.metallic[0]) or state)
    fits = started(Scene(WEAK_PRIORS, 400, 16), scene.start(0.5, photos).level, STARTS)
    assert tuple(fits) == STARTS and len(moved) == (0 if moves else len(COMPARISON.dielectric_starts))
    assert all(metallic < 0.5 for metallic in moved) and len(searched) <= len(moved)


@pytest.mark.parametrize(
    ("diffuse", "held_out", "photos", "start"),
    [
        (True, True, 40, COMPARISON.diffuse_start), (True, False, 40, COMPARISON.diffuse_start),
        (False, False, 6, COMPARISON.default_start),
    ],
)  # fmt: skip
def test_one_start_where_nothing_is_compared(diffuse: bool, held_out: bool, photos: int, start: Start) -> None:
    starts, reason = COMPARISON.compared(level(held_out, photos), diffuse, never)
    assert starts == (start,) and reason


def kind_by_few_photos(metal_error: float, moves: bool = False, smooth_error: float = 1.2) -> tuple[Start, tuple[int, int]]:
    """The start chosen without validation photos, where metal of roughness .45 has `metal_error`, the default dielectric 1 and a smooth one
    `smooth_error`, with the number of photos that trials were fitted to and compared on."""
    counts: list[tuple[int, int]] = []
    errors = dict.fromkeys(STARTS, 1.5) | {STARTS[0]: smooth_error, COMPARISON.default_start: 1.0, METAL_STARTS[1]: metal_error}

    def tried(level: Level, starts: Sequence[Start]) -> Any:
        assert not {*map(id, level.photos)} & {*map(id, level.validation)}
        counts.append((len(level.photos), len(level.validation)))
        return {start: Fit(errors[start]) for start in starts}

    (start,), reason = COMPARISON.compared(level(False, 11, "turned" if moves else None), False, tried)
    assert "100.00% error from metallic 0.05" in reason
    return start, *counts


def test_few_photos_distinguish_metal_from_dielectric_by_photos_held_out() -> None:
    start, counts = kind_by_few_photos(1 - 2 * METAL_MARGIN)
    assert start == METAL_STARTS[1] and counts == (8, 3) and COMPARISON.kind_holdout == 4
    default = COMPARISON.default_start
    assert kind_by_few_photos(1 - METAL_MARGIN / 2)[0] == default  # not clearly better
    assert kind_by_few_photos(0.9, smooth_error=0.9)[0] == default  # than the best dielectric one
    assert kind_by_few_photos(1 - 2 * METAL_MARGIN, moves=True)[0] == default
    assert kind_by_few_photos(1 - 2 * MOVING_METAL_MARGIN, moves=True)[0] == METAL_STARTS[1]


def test_the_least_error_wins() -> None:
    choice = chosen({DIELECTRIC: 0.02, OTHER: 0.018, METAL: 0.03})
    assert choice.chosen_start == OTHER and "2.00% error from metallic 0.05 roughness 0.12, 1.80% error" in choice.evidence


def test_a_metal_must_be_clearly_better() -> None:
    assert chosen({DIELECTRIC: 0.02, METAL: 0.02 * (1 - METAL_MARGIN / 2)}).chosen_start == DIELECTRIC
    assert chosen({DIELECTRIC: 0.02, METAL: 0.02 * (1 - METAL_MARGIN * 2)}).chosen_start == METAL


def test_a_metal_under_a_moving_light_must_be_better_still() -> None:
    errors = {DIELECTRIC: 0.02, METAL: 0.02 * (1 - METAL_MARGIN * 2)}
    assert chosen(errors, moving=True).chosen_start == DIELECTRIC
    assert chosen(errors | {METAL: 0.02 * (1 - MOVING_METAL_MARGIN * 1.1)}, moving=True).chosen_start == METAL


def test_the_prior_of_the_light_decides_between_equal_fits() -> None:
    """A light three times as bright as usual loses by little error and wins by much."""
    bright = {DIELECTRIC: 3 * RADIANCE[0]}
    assert chosen({DIELECTRIC: 0.02, OTHER: 0.0202}, bright).chosen_start == OTHER
    assert chosen({DIELECTRIC: 0.014, OTHER: 0.0202}, bright).chosen_start == DIELECTRIC
    assert chosen({DIELECTRIC: 0.02, METAL: 0.0202}, bright).chosen_start == DIELECTRIC  # not between metal and dielectric
