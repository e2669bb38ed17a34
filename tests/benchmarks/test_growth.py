"""Factors per doubling of known power laws."""

from __future__ import annotations

import pytest

from benchmarks.growth import Cell, per_doubling, summary, with_doublings


@pytest.mark.parametrize("power", [0.5, 1.0, 1.6])
def test_a_power_law_has_a_constant_factor(power: float) -> None:
    assert per_doubling((12, 3 * 12**power), (96, 3 * 96**power)) == pytest.approx(2**power)


def test_doublings_are_per_curve_and_per_pixel() -> None:
    cells = [Cell("photos", "mesh", 24, 5.0), Cell("photos", "mesh", 12, 2.0), Cell("photos", "bake", 12, 9.0)]
    cells += [Cell("resolution", "stereo", 200, 1.0), Cell("resolution", "stereo", 400, 4.0)]
    found = {(c.what, c.size): c.per_doubling for c in with_doublings(cells)}
    assert found == {("mesh", 12): None, ("mesh", 24): 2.5, ("bake", 12): None, ("stereo", 200): None, ("stereo", 400): 2.0}


def test_the_summary_marks_curves_over_the_maximum() -> None:
    cells = with_doublings(
        [Cell("photos", w, n, s) for w, n, s in (("mesh", 12, 2.0), ("mesh", 24, 5.0), ("bake", 12, 2.0), ("bake", 24, 4.0))]
    )
    verdicts = {line.split()[1]: line.split()[-2] for line in summary(cells).splitlines()}
    assert verdicts == {"mesh": "OVER", "bake": "within"}
