"""Trials of metal and dielectric on spheres of known kind, fitted as the other one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsbake.materials.fit import MaterialFit
from gsbake.materials.fit_surface import Fitted
from gsbake.materials.initialisation import ChosenFit
from gsbake.materials.levels import FitLevel
from gsbake.materials.metal_trials import GROUPS, MIN_SHARE, TrialResult, Turn, _groups, _Trials, try_kinds
from gsbake.materials.options import FitSchedule
from gsbake.materials.two_level_fit import FitPlan, _with_better_metals
from tests.materials.test_fit import Scene
from tests.support.slow import slow

QUIET = FitSchedule(120, metal_searches_at=(), emission=False, light_searches_at=(), sparsity=False, normals=False)
TRIAL = replace(QUIET, iterations=40, rate=0.3)


def nothing(done: int, total: int) -> None:
    pass


def tried(scene: Scene, start: float, validation: int = 2) -> tuple[MaterialFit, Fitted, TrialResult]:
    """A fit in which all texels stay of the kind that they start as, and what trials made of it."""
    fit = scene.fit(0.3, metallic=start)
    level = FitLevel(scene.surface(), scene.photos[validation:], scene.photos[:validation])
    before = fit.run(level.fitted, level.held_out, QUIET)
    return fit, before, try_kinds(fit, before, level, TRIAL, nothing)


@pytest.mark.parametrize("start", [0.05, slow(0.9)])
def test_groups_of_the_wrong_kind_are_turned(start: float) -> None:
    scene = Scene(0.25, metallic=1.0, striped=True)
    _, before, found = tried(scene, start)
    known, truth = before.weight > 0.3, scene.metallic > 0.5
    was, now = ((fitted.values[known, 4] > 0.5) for fitted in (before, found.fitted))
    assert (was != truth[known]).mean() > 0.3
    assert (now != was).mean() > 0.05
    assert (now == truth[known])[now != was].mean() > 0.7
    assert {group.metal for group in found.turned} == {start < 0.5}
    assert "metal" in str(found) or "dielectric" in str(found)
    assert before.held_out_loss is not None and found.fitted.held_out_loss is not None
    assert found.fitted.held_out_loss < before.held_out_loss


@pytest.mark.slow
def test_groups_that_are_likelier_as_metal_are_turned_together(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, tries = _Trials._try, []

    def spy(self: _Trials, models: Any, metal: bool, groups: list[Any]) -> bool:
        observed = self.state.values.copy()
        kept = plain(self, models, metal, groups)
        tries.append((metal, len(groups), kept, int((observed != self.state.values).any(1).sum())))
        return kept

    monkeypatch.setattr(_Trials, "_try", spy)
    _, _, found = tried(Scene(0.25, metallic=1.0, striped=True), 0.05)
    metal, groups, kept, changed = tries[0]
    assert metal and groups > 1 and kept and changed
    assert all(count == 1 for _, count, *_ in tries[2:])
    assert found.turned[0].metal and found.turned[0].share > 2 * MIN_SHARE


@pytest.mark.slow
def test_groups_of_the_right_kind_stay() -> None:
    fit, before, _ = tried(Scene(0.25), 0.05)
    assert (fit.state().values[before.weight > 0.3, 4] > 0.5).mean() < 0.03


@pytest.mark.parametrize("turned", [slow(()), (Turn(True, 0.1, 0.1),)])
def test_the_light_is_searched_for_again_where_kinds_changed(turned: tuple[Turn, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.materials.two_level_fit.try_kinds", lambda _, fitted, *__: TrialResult(fitted, 1, turned))
    scene = Scene(0.25)
    fit, level = scene.fit(0.3, metallic=0.05), FitLevel(scene.surface(), scene.photos[2:], scene.photos[:2])
    start = ChosenFit(fit, fit.run(level.fitted, level.held_out, QUIET), 0.05, 0.3, 1, "")
    choice = _with_better_metals(start, level, FitPlan(120, 16, fit._priors), nothing)
    assert len(choice.fitted.light_adjustments) == len(turned)


@pytest.mark.slow
def test_the_fit_ends_in_the_state_that_was_kept() -> None:
    fit, _, found = tried(Scene(0.25, metallic=1.0), 0.05)
    kept = fit.state().values
    assert found.trials > 0
    assert np.abs(kept[:, 4] - found.fitted.values[:, 4]).mean() < 0.1  # `fitted` is some steps further


def test_nothing_is_tried_without_validation_photos() -> None:
    _, before, found = tried(Scene(0.25), 0.05, validation=0)
    assert found.trials == 0 and found.fitted is before


def test_texels_of_one_group_are_similar_and_small_groups_are_left_out() -> None:
    rng = np.random.default_rng(0)
    kind = rng.random(2000) < 0.3
    colour = np.where(kind[:, None], [0.5, 0.2, 0.1], [0.2, 0.4, 0.3]) * rng.uniform(0.9, 1.1, (2000, 1))
    values = np.column_stack([colour, np.full(2000, 0.4), np.full(2000, 0.05)])
    observed = np.arange(2000) < 1900
    groups = _groups(values, colour, observed)
    assert 1 < len(groups) <= GROUPS
    assert all(kind[group].all() or not kind[group].any() for group in groups)
    assert all(len(group) >= MIN_SHARE * 1900 and observed[group].all() for group in groups)
    assert len(np.unique(np.concatenate(groups))) == sum(map(len, groups))


def test_no_texels_have_no_groups() -> None:
    assert _groups(np.zeros((5, 5)), np.zeros((5, 3)), np.zeros(5, bool)) == []
