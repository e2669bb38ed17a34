"""The split-sum table against brute-force integration and its known limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsbake.shading import brdf
from tests.support.directional_albedo import albedo_of_conductor, albedo_of_dielectric, single_scattering


@pytest.mark.parametrize("cosine", [0.05, 0.15, 0.37, 0.71, 0.98])
@pytest.mark.parametrize("roughness", [0.1, 0.24, 0.5, 0.77, 1.0])
def test_against_single_scattering(cosine: float, roughness: float) -> None:
    found = brdf.directional_albedo(np.array([cosine]), np.array([roughness**2]))[0]
    np.testing.assert_allclose(found, single_scattering(cosine, roughness), atol=0.006)


@pytest.mark.parametrize(("cosine", "roughness"), [(0.3, 0.3), (0.65, 0.56), (0.9, 0.56), (0.5, 0.9)])
def test_light_between_microfacets(cosine: float, roughness: float) -> None:
    split = brdf.split_sum(torch.tensor([cosine], dtype=torch.float64), torch.tensor([roughness], dtype=torch.float64))
    assert split.dielectric.item() == pytest.approx(albedo_of_dielectric(cosine, roughness), rel=0.02)
    if roughness < 0.6:  # for rougher conductors the albedo is far from linear in F0
        for f0 in (0.4, 0.6, 0.9):
            assert f0 * split.scale.item() + split.bias.item() == pytest.approx(albedo_of_conductor(cosine, roughness, f0), rel=0.05)


def test_fresnel_of_a_dielectric() -> None:
    assert brdf.dielectric_fresnel(np.array([1.0]))[0] == pytest.approx(0.04)
    assert brdf.dielectric_fresnel(np.array([0.0]))[0] == pytest.approx(1)
    # At Brewster's angle, tan θ = 1.5, only the perpendicular polarisation is reflected: ((n² − 1)/(n² + 1))² of it.
    assert brdf.dielectric_fresnel(np.array([1 / math.sqrt(1 + 1.5**2)]))[0] == pytest.approx(0.5 * (1.25 / 3.25) ** 2)


def test_limits() -> None:
    cosine = torch.linspace(0.02, 1.0, 40)
    split = brdf.split_sum(cosine, torch.zeros(40))
    schlick = (1 - cosine) ** 5  # a perfect mirror is Schlick's term itself
    torch.testing.assert_close(split.bias, schlick, atol=4e-3, rtol=0)
    torch.testing.assert_close(split.scale, 1 - schlick, atol=4e-3, rtol=0)
    torch.testing.assert_close(split.dielectric, torch.as_tensor(brdf.dielectric_fresnel(cosine.numpy())).float(), atol=4e-3, rtol=0)
    table = brdf.split_sum_table()
    assert np.isfinite(table).all()
    assert (table[..., :2] >= 0).all() and (table[..., 5] > 0).all()
    assert (table[..., 0] + table[..., 1] <= 1 + 1e-5).all() and (table[..., 5] <= 1 + 1e-6).all()  # no energy is made
    # α = 1 head-on: the albedo of uniform GGX, by brute force.
    head_on = brdf.directional_albedo(np.array([1 - 1e-9]), np.array([1.0]))[0, :2].sum()
    assert head_on == pytest.approx(sum(single_scattering(1 - 1e-9, 1.0)[:2]), abs=2e-3)


def test_gradient() -> None:
    cosine = torch.tensor([0.013, 0.21, 0.5, 0.93], dtype=torch.float64, requires_grad=True)
    rough = torch.tensor([0.11, 0.35, 0.62, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *at: tuple(vars(brdf.split_sum(*at)).values()), (cosine, rough))


def test_table_is_built_quickly() -> None:
    import time

    brdf.split_sum_table.cache_clear()
    start = time.thread_time()
    brdf.split_sum_table()
    assert time.thread_time() - start < 1.0
