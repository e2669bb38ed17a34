"""The error of the float32 kernels against the float64 reference is small over the grid of `benchmarks.numerics`."""

from __future__ import annotations

import pytest

from benchmarks.numerics import FIELDS, SCALES, errors


@pytest.mark.parametrize(("scale", "field"), [(SCALES[0], FIELDS[-1]), (SCALES[3], FIELDS[2]), (SCALES[-1], FIELDS[0])])
def test_corners_of_the_grid(scale: float, field: float) -> None:
    colour, off, other = errors(scale, field)
    assert 0 < colour < 1e-4 and off < 1e-3 and other < 2e-3


@pytest.mark.stress
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("scale", SCALES)
def test_whole_grid(scale: float, field: float) -> None:
    assert 0 < errors(scale, field)[0] < 1e-4
