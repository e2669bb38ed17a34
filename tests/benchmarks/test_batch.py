"""Ratios of rounds with known times."""

from __future__ import annotations

import pytest

from benchmarks.batch import Row, ratios, summary


def test_ratios_of_a_round() -> None:
    rows = [
        Row(0, "loop", 4, 100.0, 90.0, 100.0, 1.0, 0.0),
        Row(0, "one", 4, 110.0, 99.0, 99.0, 0.9, 0.0),
        Row(0, "two", 4, 60.0, 99.0, 108.0, 0.9, 0.0),
    ]
    (found,) = ratios(rows)
    assert found.overhead == pytest.approx(0.1) and found.gaps == pytest.approx(0.1)
    assert found.workers == pytest.approx(2.0)  # no slower side by side, and as busy
    assert found.wall_overhead == pytest.approx(0.1) and found.wall_workers == pytest.approx(110 / 60)
    assert "+10.0% (+10.0% to +10.0%)" in summary([found])
