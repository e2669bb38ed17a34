"""The albedos that `benchmarks.furnace` compares with Cycles."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.furnace import SIZE, model_albedo, sphere_cosine
from tests.support.directional_albedo import albedo_of_conductor, albedo_of_dielectric, single_scattering


def test_sphere_fills_the_picture() -> None:
    cosine = sphere_cosine()
    assert cosine.shape == (SIZE, SIZE) and cosine[SIZE // 2, SIZE // 2] > 0.999 and cosine[0, 0] == 0
    assert (cosine > 0).mean() == pytest.approx(np.pi / 4, abs=0.01)


@pytest.mark.parametrize(("roughness", "cosine"), [(0.3, 0.65), (0.56, 0.45)])
def test_columns(roughness: float, cosine: float) -> None:
    """The model, and the formula with Schlick's term and a single scattering, against brute force."""
    scale, bias, _ = single_scattering(cosine, roughness)
    model, single = model_albedo(np.array([cosine]), 0.0, roughness, 0.0)[0]
    assert model == pytest.approx(albedo_of_dielectric(cosine, roughness), rel=0.02)
    assert single == pytest.approx(0.04 * scale + bias, rel=0.02)
    model, single = model_albedo(np.array([cosine]), 0.6, roughness, 1.0)[0]
    assert model == pytest.approx(albedo_of_conductor(cosine, roughness, 0.6), rel=0.04)
    assert single == pytest.approx(0.6 * scale + bias, rel=0.02)
