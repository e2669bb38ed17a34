"""The prior of the light's intensity against Student's t, tabulated metals, and lights of a known radiance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats

from benchmarks.light_levels import mean_radiance, median_and_scale
from gsbake.materials.light_intensity import DIELECTRICS, METALS, OBSERVATIONS, RADIANCE, TRIED_FACTORS, IntensityPrior
from gsbake.materials.surface import Materials

#: Normal reflectances, strongest channel (Lagarde & de Rousiers 2014, table 4; iron from the same course).
PURE_METALS = {
    "silver": 0.971, "aluminium": 0.924, "gold": 1.0, "copper": 0.955, "chromium": 0.556, "nickel": 0.659, "titanium": 0.541,
    "cobalt": 0.662, "platinum": 0.672, "iron": 0.58,
}  # fmt: skip


def test_the_prior_is_student_t_of_the_logarithms() -> None:
    prior = IntensityPrior(0.2, 0.8, 1.5)

    def density(factor: float) -> float:
        known = [(0.2 / factor, DIELECTRICS), (0.8 / factor, METALS), (1.5 * factor, RADIANCE)]
        return float(sum(stats.t.logpdf(np.log(value / median) / scale, 2) for value, (median, scale) in known))

    for factor in (0.3, 0.8, 2.5):
        assert prior.negative_log(factor) - prior.negative_log(1) == pytest.approx(density(1) - density(factor))


def test_constants_of_metals_are_those_of_the_table() -> None:
    median, scale = median_and_scale(list(PURE_METALS.values()))
    assert METALS[0] == pytest.approx(median, abs=0.01)
    assert scale < METALS[1] < 2 * scale  # worn and dirty metals differ more


def test_the_mean_of_the_prior() -> None:
    """Against SciPy's quadrature; metals alone ask for their own factor."""
    prior = IntensityPrior(0.2, 0.8, 1.5)
    bounds = -math.log(4), math.log(4)
    moments = [integrate.quad(lambda x, k=k: x**k * math.exp(-prior.negative_log(math.exp(x))), *bounds)[0] for k in (0, 1)]
    assert math.log(prior.mean_factor()) == pytest.approx(moments[1] / moments[0], abs=1e-3)
    assert IntensityPrior(metals=METALS[0]).mean_factor() == pytest.approx(1)
    assert IntensityPrior().mean_factor() == pytest.approx(1)


def test_the_open_factors_of_a_prior_are_those_of_its_density() -> None:
    """Against SciPy's density of Student's t: e⁻² of the highest at both ends, to a step of the factors."""
    low, high = IntensityPrior(radiance=1.25 * RADIANCE[0]).open_factors()
    for bound in (low, high):
        x = math.log(1.25 * bound) / RADIANCE[1]
        assert stats.t.logpdf(0, 2) - stats.t.logpdf(x, 2) == pytest.approx(2, abs=0.12)
    assert low < 1 / 1.25 < high


def test_the_open_factors_by_photos_are_those_of_their_residuals() -> None:
    """Without a prior, residuals that grow like exp(5 x²) count as a normal density of standard deviation .1 about .8."""
    x = np.log(TRIED_FACTORS / 0.8)
    bounds = IntensityPrior().open_factors(0.02 * np.exp(0.5 * x**2 / 0.1**2 / OBSERVATIONS))
    assert np.log(bounds) == pytest.approx(np.log(0.8) + np.array([-0.2, 0.2]), abs=0.025)


def test_quantities_that_contradict_each_other_meet_between() -> None:
    """Metals ask for a light three times as dim, the light for one twice or three times as bright: no small change moves the result far."""
    factors = [IntensityPrior(metals=METALS[0] / 3, radiance=RADIANCE[0] / less).mean_factor() for less in (2.0, 2.7, 3.0, 3.3, 4.0)]
    assert 1 / 3 < factors[0] < factors[-1] < 3
    assert max(b / a for a, b in zip(factors, factors[1:], strict=False)) < 1.5


def test_what_counts_of_an_object() -> None:
    metal = np.arange(100) < 40
    base = np.where(metal[:, None], [0.5, 0.7, 0.6], [0.1, 0.3, 0.2])
    materials = Materials(base, np.full(100, 0.5), metal.astype(float))
    light = np.full((6, 4, 4, 3), 0.9, np.float32)
    assert IntensityPrior.of(materials, ~metal, None) == IntensityPrior(pytest.approx(0.31), pytest.approx(0.7))
    assert IntensityPrior.of(materials, ~metal, light) == IntensityPrior(pytest.approx(0.31), pytest.approx(0.7), pytest.approx(0.9))
    few = np.arange(100) < 4
    assert IntensityPrior.of(replace(materials, metallic=(~few).astype(float)), few, light).dielectrics is None  # too small a share


def test_mean_radiance_weighs_by_solid_angle() -> None:
    """An upper hemisphere of radiance 2, and a band around the pole that covers 1 - cos 45° of a hemisphere."""
    image = np.zeros((64, 128, 3), np.float32)
    image[:32] = 2
    assert mean_radiance(image) == pytest.approx(1, rel=1e-3)
    image[16:] = 0
    assert mean_radiance(image) == pytest.approx(1 - np.cos(np.pi / 4), rel=1e-3)
