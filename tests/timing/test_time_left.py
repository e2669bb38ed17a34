"""The time left under simulated progress: right within a factor, and never far above the time so far."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from gsbake.timing.estimate import Estimate
from gsbake.timing.time_left import MAX_RATIO, TimeLeft


@dataclass(frozen=True)
class Part:
    """A part of a simulated stage: its name, the seconds of its steps, and how many runs of so many steps report from one on."""

    name: str
    steps: tuple[float, ...]
    runs: int = 1

    @property
    def seconds(self) -> float:
        return sum(self.steps) * self.runs


def simulate(parts: list[Part], expected: Estimate | None = None) -> Iterator[tuple[float, float | None, float]]:
    """(time so far, seconds left as given, truly left) after every step and each second between."""
    left, now, whole = TimeLeft(0.0, expected), 0.0, sum(part.seconds for part in parts)
    for part in parts:
        left.start_part(now, part.name)
        for _ in range(part.runs):
            for done, seconds in enumerate(part.steps, 1):
                for waited in np.arange(1.0, seconds):
                    yield now + waited, left.seconds(now + waited), whole - now - waited
                now += seconds
                if len(part.steps) > 1:
                    left.update(now, done, len(part.steps))
                if done < len(part.steps):  # after the last one the next part starts at once
                    yield now, left.seconds(now), whole - now


def history(parts: list[Part], scale: float = 1.0, same: bool = True) -> Estimate:
    """What is expected after an earlier run of the same parts that was `scale` times as long."""
    whole = sum(part.seconds for part in parts)
    return Estimate(scale * whole, 0, 1, {part.name: part.seconds / whole for part in parts}, same)


def ratios(parts: list[Part], expected: Estimate | None, from_share: float = 0.0) -> list[float]:
    """Given and true seconds left beyond a share of the stage, where both are above three seconds."""
    whole = sum(part.seconds for part in parts)
    found = [(now, given, true) for now, given, true in simulate(parts, expected) if now >= from_share * whole and true > 3]
    return [given / true for _, given, true in found if given is not None]


#: Like textures with a material fit: parts of very different steps, one of several short fits, and steps with a search.
BAKE = [
    Part("atlas", (10.0,)),
    Part("occlusion", (0.3,) * 64),
    Part("projection", (0.4,) * 48),
    Part("trial fits", (0.1,) * 500),
    Part("coarse level", (*(0.1,) * 100, 20.0, *(0.1,) * 100, 20.0, *(0.1,) * 100)),
    Part("metals", (0.1,) * 60, runs=8),
    Part("fine level", (*(0.2,) * 30, 25.0, *(0.2,) * 70)),
    Part("write", (3.0,)),
]


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
@pytest.mark.parametrize("same", [True, False])
def test_with_earlier_runs_it_is_right_within_a_factor(scale: float, same: bool) -> None:
    found = ratios(BAKE, history(BAKE, scale, same))
    assert len(found) > 500 and min(found) > 1 / 3 and max(found) < 3
    close = 1.5 if scale == 1 else 2.2  # with an expectation that is half or twice the truth
    assert np.mean([1 / close < ratio < close for ratio in found]) > 0.9


def test_forty_seconds_before_the_end_it_does_not_say_twelve_minutes() -> None:
    """A step of the last part contains a search: the rate of the last steps alone gave 17 times the truth."""
    last = [given for _, given, true in simulate(BAKE, history(BAKE, 1.3)) if 3 < true < 40]
    assert last and all(given is not None and given < 60 for given in last)


def test_without_earlier_runs_the_usual_shares_do() -> None:
    """Nothing but the order of magnitude is known: a formula that is off by five, and shares that are off by half."""
    whole = sum(part.seconds for part in BAKE)
    factors = dict(zip((part.name for part in BAKE), (1.5, 0.7, 1.4, 0.6, 1.2, 0.7, 1.4, 1.0), strict=True))
    shares = {part.name: part.seconds / whole * factors[part.name] for part in BAKE}
    for scale in (0.2, 5.0):
        found = ratios(BAKE, Estimate(scale * whole, 0, parts=shares), from_share=0.2)
        assert min(found) > 1 / 4 and max(found) < 4, scale
        assert 0.6 < math.exp(np.mean(np.log(found))) < 1.8


def test_a_wrong_early_rate_is_unknown_not_hours() -> None:
    """Three steps of half a minute each before the rest takes seconds."""
    slow_start = [Part("training", (30.0, 30.0, 30.0, *(0.05,) * 997))]
    found = list(simulate(slow_start))
    assert all(given is None or given <= MAX_RATIO * now for now, given, _ in found)
    assert all(given is None for now, given, _ in found if now < 90)
    left = TimeLeft(0.0)
    left.start_part(0.0, "training")
    for step in (1, 2):
        left.update(30.0 * step, step, 1000)
    assert left.text(60.0) == "time left unknown"


@pytest.mark.parametrize("seed", range(40))
def test_nothing_above_ten_times_the_time_so_far(seed: int) -> None:
    """Any progress, any expectation."""
    rng = np.random.default_rng(seed)
    names = [f"part {k}" for k in range(int(rng.integers(1, 6)))]
    parts = [Part(n, tuple(rng.exponential(10 ** rng.uniform(-2, 1.5), int(rng.integers(1, 40)))), int(rng.integers(1, 4))) for n in names]
    expected = Estimate(10 ** rng.uniform(-1, 5), 0, int(rng.integers(0, 2)), {n: rng.uniform(0, 0.5) for n in names[1:]}, seed % 2 == 0)
    for case in (None, expected):
        assert all(given is None or 0 < given <= MAX_RATIO * now for now, given, _ in simulate(parts, case))


def test_a_first_step_that_compiles_does_not_count() -> None:
    """60 s of compilation, then 20 steps a second: 1000 steps take 50 s, not 16 hours."""
    found = [(now, given) for now, given, _ in simulate([Part("training", (60.0, *(0.05,) * 999))]) if now > 60.2]
    assert all(given == pytest.approx(110 - now, rel=0.05) for now, given in found if given is not None and now < 108)


def test_a_slower_second_half() -> None:
    """At full resolution a step takes four times as long: what the steps say is corrected by an earlier run."""
    parts = [Part("training", (*(0.2,) * 250, *(0.8,) * 250))]

    def at_the_end_of_the_first(expected: Estimate | None) -> list[float]:
        return [given / true for now, given, true in simulate(parts, expected) if given is not None and 40 < now < 50]

    corrected, plain = at_the_end_of_the_first(history(parts)), at_the_end_of_the_first(None)
    assert min(corrected) > 1 / 3 > max(plain)


def test_parts_that_are_left_out_and_parts_that_are_new() -> None:
    """What an earlier run did and this one does not, and the other way round, upsets nothing."""
    expected = history([*BAKE[:4], *BAKE[6:]])
    found = [r for r in ratios(BAKE[:3] + BAKE[4:], expected, from_share=0.1)]
    assert min(found) > 1 / 5 and max(found) < 5


def test_parts_with_other_names_than_in_an_earlier_run() -> None:
    """As after an update that times one part in three: the time of the new ones counts against the old."""
    whole = sum(part.seconds for part in BAKE)
    fit = sum(part.seconds for part in BAKE[3:7])
    known = {part.name: part.seconds / whole for part in BAKE[:3]} | {"fit": fit / whole, "write": 3 / whole}
    found = ratios(BAKE, Estimate(whole, 0, 1, known, same=True), from_share=0.1)
    assert min(found) > 1 / 2 and np.mean([ratio < 2 for ratio in found]) > 0.9 and max(found) < 10


def test_nothing_is_known_of_a_first_step_that_never_ends() -> None:
    left = TimeLeft(0.0)
    left.update(0.0, 0, 100)
    assert left.seconds(500.0) is None and left.text(500.0) == "time left unknown"


def test_words() -> None:
    left = TimeLeft(0.0, Estimate(100.0, 0, 1, {"a": 0.5, "b": 0.5}, same=True))
    left.start_part(0.0, "a")
    assert left.text(5.0) == "time left unknown"  # 95 s, more than ten times the time so far
    assert left.text(20.0) == "about 1 min 20 s left"
