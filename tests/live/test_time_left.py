"""The time left is that of the steps, not of the compilation before them."""

from __future__ import annotations

import pytest

from gsbake.live.time_left import TimeLeft


def test_a_first_step_that_compiles_does_not_count() -> None:
    """60 s of compilation, then 20 steps a second: 1000 steps take 50 s, not 16 hours."""
    left = TimeLeft()
    assert left.update(60.0, 1, 1000) is None
    found = [left.update(60.0 + k / 20, 1 + k, 1000) for k in range(1, 400)]
    assert all(value is None for value in found[:30])
    known = [value for value in found if value is not None]
    assert known[0] == pytest.approx(0.05 * (1000 - 42), rel=0.05)
    assert known[-1] == pytest.approx(0.05 * 600, rel=0.05)


def test_the_rate_is_that_of_the_last_seconds() -> None:
    left, now = TimeLeft(), 0.0
    for step in range(1, 101):  # the second half is at full resolution and four times as slow
        now += 1.0 if step <= 50 else 4.0
        value = left.update(now, step, 200)
    assert value == pytest.approx(400, rel=0.1)


def test_a_new_part_starts_over() -> None:
    left = TimeLeft()
    for k in range(1, 10):
        left.update(float(k), k, 10, "matching")
    assert left.update(9.5, 1, 10, "consistency") is None
    assert left.update(10.0, 0, 5) is None


def test_nothing_is_known_of_a_first_step_that_never_ends() -> None:
    left = TimeLeft()
    assert left.update(0.0, 0, 100) is None and left.update(500.0, 0, 100) is None


def test_a_finished_part_has_nothing_left() -> None:
    left = TimeLeft()
    assert [left.update(float(k), k, 8) for k in range(1, 9)][-1] == 0.0
