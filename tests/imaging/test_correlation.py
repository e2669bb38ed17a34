"""Correlation in windows against NumPy's correlation coefficient."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.imaging.correlation import Windows, window_mean

SIZE = 5


@pytest.mark.parametrize("row, column", [(7, 9), (2, 2), (17, 21)])
def test_it_is_the_correlation_coefficient(row: int, column: int) -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 255, (20, 24)).astype(np.float32)
    b = (0.6 * a + rng.normal(0, 40, a.shape)).astype(np.float32)
    window = np.s_[row - 2 : row + 3, column - 2 : column + 3]
    expected = float(np.corrcoef(a[window].ravel(), b[window].ravel())[0, 1])
    first, second = Windows.of(a, SIZE), Windows.of(b, SIZE)
    assert first.correlate(second, expected - 0.01)[row, column] and not first.correlate(second, expected + 0.01)[row, column]
    assert first.deviation[row, column] == pytest.approx(a[window].std(), rel=1e-3)
    assert first.mean[row, column] == pytest.approx(a[window].mean(), rel=1e-5)
    assert first.contrast(second)[row, column] == pytest.approx(max(a[window].std(), b[window].std()), rel=1e-3)
    assert window_mean(a, SIZE)[row, column] == pytest.approx(a[window].mean(), rel=1e-5)


def test_exposure_does_not_matter() -> None:
    a = np.random.default_rng(1).uniform(0, 255, (20, 24)).astype(np.float32)
    assert Windows.of(a, SIZE).correlate(Windows.of(np.float32(0.4) * a + 20, SIZE), 0.999).all()
    plain = np.full((20, 24), 80, np.float32)
    assert not Windows.of(plain, SIZE).correlate(Windows.of(plain, SIZE), 0.9).any()
