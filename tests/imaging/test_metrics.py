"""PSNR against known values, and normalisation of vectors."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.geometry.vectors import unit
from gsbake.imaging.metrics import MAX_PSNR, decibels


def test_decibels() -> None:
    assert decibels(0.01) == pytest.approx(20) and decibels(1.0) == 0 and decibels(0.0) == MAX_PSNR


def test_unit_keeps_the_type_and_zero_vectors() -> None:
    single = unit(np.array([[3, 0, 4], [0, 0, 0]], np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, [[0.6, 0, 0.8], [0, 0, 0]], rtol=1e-6)
    double = unit(np.array([[[1e-12, 0.0]], [[0.0, -5.0]]]))
    assert double.dtype == np.float64
    np.testing.assert_allclose(double, [[[1, 0]], [[0, -1]]])
