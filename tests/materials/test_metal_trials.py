"""Trials of metal and dielectric on spheres of known kind, fitted as the other one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsbake.materials import metal_trials
from gsbake.materials.descent import Steps
from gsbake.materials.metal_trials import GROUPS, MIN_SHARE, OPTIONS, KindTrials, LightLevel, _groups, _Tried
from gsbake.materials.passes import Scene
from gsbake.materials.recipe import ADAPT_AND_SEARCH
from gsbake.materials.state import State
from gsbake.materials.surface import Materials
from gsbake.shading.environment import EnvironmentLight
from tests.materials.test_fit import WEAK_PRIORS, Sphere, after, observed
from tests.support.slow import slow

QUIET = Steps(1.0, sparsity=False)
TRIALS = KindTrials(Steps(0.1, rate=0.3, sparsity=False))
SCENE = Scene(WEAK_PRIORS, 400, 16)


def tried(scene: Sphere, start: float) -> tuple[State, State]:
    """A fit in which all texels stay of the kind that they start as, and what trials made of it."""
    before = after(scene.start(0.3, held_out=2, metallic=start), 120, QUIET)
    return before, TRIALS.run(SCENE, before)


@pytest.mark.parametrize("start", [0.05, slow(0.9)])
def test_groups_of_the_wrong_kind_are_turned(start: float) -> None:
    scene = Sphere(0.25, metallic=1.0, striped=True)
    before, found = tried(scene, start)
    known, truth = observed(before), scene.metallic > 0.5
    was, now = before.metal[known], found.metal[known]
    assert (was != truth[known]).mean() > 0.3
    assert (now != was).mean() > 0.05
    assert (now == truth[known])[now != was].mean() > 0.7
    assert found.kinds_changed and ("% of the texels metal" in found.evidence) == (start < 0.5)
    assert found.error < before.error


@pytest.mark.slow
def test_groups_that_are_likelier_as_metal_are_turned_together(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, tries = _Tried.with_trial, []

    def spy(self: _Tried, models: Any, metal: bool, groups: list[Any], known: Any) -> _Tried:
        next_one = plain(self, models, metal, groups, known)
        tries.append((metal, len(groups), len(next_one.turns) > len(self.turns)))
        return next_one

    monkeypatch.setattr(_Tried, "with_trial", spy)
    before, found = tried(Sphere(0.25, metallic=1.0, striped=True), 0.05)
    metal, groups, kept = tries[0]
    assert metal and groups > 1 and kept
    assert all(count == 1 for _, count, _ in tries[2:])
    assert (found.metal & ~before.metal).mean() > 2 * MIN_SHARE


def test_trials_end_after_some_that_changed_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    state, tries = after(Sphere(0.25).start(0.3, held_out=2), 3, QUIET), []

    def refused(self: _Tried, models: Any, metal: bool, groups: list[Any], known: Any) -> _Tried:
        tries.append(groups)
        return replace(self, count=self.count + 1)

    every = [(1.0, True, np.arange(9))] * 9
    monkeypatch.setattr(metal_trials, "_candidates", lambda base, known: (None, every))
    monkeypatch.setattr(_Tried, "with_trial", refused)
    found = TRIALS.run(replace(SCENE, iterations=10), state)
    assert len(tries) == OPTIONS.max_refused < len(every) and "4 trials" in found.evidence


@pytest.mark.slow
def test_groups_of_the_right_kind_stay() -> None:
    before, found = tried(Sphere(0.25), 0.05)
    assert found.metal[observed(before)].mean() < 0.03


@pytest.mark.parametrize("changed", [slow(False), True])
def test_the_light_is_searched_for_again_where_kinds_changed(changed: bool) -> None:
    state = replace(after(Sphere(0.25).start(0.3, held_out=2), 20, QUIET), kinds_changed=changed)
    found = LightLevel(ADAPT_AND_SEARCH).run(replace(SCENE, iterations=40), state)
    assert len(found.adjustments) == changed


def test_the_light_returns_to_the_intensity_that_searches_had_left() -> None:
    before = after(Sphere(0.25).start(0.3, held_out=2), 5, QUIET)
    brighter = before.under_light(replace_light(before, 1.5), np.flatnonzero(before.emits_nothing))
    found = LightLevel(ADAPT_AND_SEARCH).run(SCENE, replace(brighter, intensity=before.mean_intensity))
    np.testing.assert_allclose(found.mean_intensity, before.mean_intensity, rtol=1e-4)
    np.testing.assert_allclose(found.materials.base_color, before.materials.base_color, rtol=1e-3)


def replace_light(state: State, factor: float) -> EnvironmentLight:
    return EnvironmentLight.from_radiance(state.radiance * np.float32(factor))


def test_trials_need_validation_photos_and_a_light_that_stands() -> None:
    scene = Sphere(0.25)
    assert TRIALS.applies(SCENE, scene.start(0.3, held_out=2))
    assert not TRIALS.applies(SCENE, scene.start(0.3)) and not TRIALS.applies(replace(SCENE, diffuse=True), scene.start(0.3, held_out=2))
    moving = scene.start(0.3, [replace(photo, to_light=np.eye(3)) for photo in scene.photos], 2)
    assert not TRIALS.applies(SCENE, moving)


def test_texels_of_one_group_are_similar_and_small_groups_are_left_out() -> None:
    rng = np.random.default_rng(0)
    kind = rng.random(2000) < 0.3
    colour = np.where(kind[:, None], [0.5, 0.2, 0.1], [0.2, 0.4, 0.3]) * rng.uniform(0.9, 1.1, (2000, 1))
    materials = Materials(colour, np.full(2000, 0.4), np.full(2000, 0.05))
    shown = np.arange(2000) < 1900
    groups = _groups(materials, colour, shown)
    assert 1 < len(groups) <= GROUPS
    assert all(kind[group].all() or not kind[group].any() for group in groups)
    assert all(len(group) >= MIN_SHARE * 1900 and shown[group].all() for group in groups)
    assert len(np.unique(np.concatenate(groups))) == sum(map(len, groups))


def test_no_texels_have_no_groups() -> None:
    assert _groups(Materials(np.zeros((5, 3)), np.zeros(5), np.zeros(5)), np.zeros((5, 3)), np.zeros(5, bool)) == []
