"""The split-sum table against brute-force integration and its known limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsbake.shading import brdf


def brute_force(cosine: float, roughness: float) -> tuple[float, float]:
    """∫ (n·l) D G2 / (4 n·l n·v) {1−Fc, Fc} dl on a grid over half-vectors, dl = 4 (v·h) dh; no importance sampling, textbook formulas."""
    alpha = roughness**2
    # t = tan θ_h on a stretched grid, so that narrow and wide lobes are both resolved.
    t = alpha * np.tan((np.arange(2000) + 0.5) / 2000 * math.pi / 2)
    dt = alpha * (1 + (t / alpha) ** 2) * (math.pi / 2 / 2000)
    phi = (np.arange(720) + 0.5) / 720 * math.pi
    cos_h = 1 / np.sqrt(1 + t * t)[:, None]
    sin_h = t[:, None] * cos_h
    dh = 2 * (cos_h**3 * t[:, None] * dt[:, None]) * (math.pi / 720)  # sinθ dθ dφ, both halves
    vh = sin_h * np.cos(phi)[None] * math.sqrt(1 - cosine**2) + cos_h * cosine
    nl = 2 * vh * cos_h - cosine
    lit = (vh > 0) & (nl > 0)
    density = alpha**2 / (math.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)
    lam = lambda c: (np.sqrt(1 + alpha**2 * (1 - c * c) / (c * c)) - 1) / 2  # noqa: E731
    shadow = 1 / (1 + lam(np.where(lit, nl, 1.0)) + lam(cosine))
    value = np.where(lit, density * shadow * vh / cosine * dh, 0.0)
    fresnel = (1 - np.clip(vh, 0, 1)) ** 5
    return float((value * (1 - fresnel)).sum()), float((value * fresnel).sum())


@pytest.mark.parametrize("cosine", [0.05, 0.15, 0.37, 0.71, 0.98])
@pytest.mark.parametrize("roughness", [0.1, 0.24, 0.5, 0.77, 1.0])
def test_against_brute_force(cosine: float, roughness: float) -> None:
    split = brdf.split_sum(torch.tensor([cosine], dtype=torch.float64), torch.tensor([roughness], dtype=torch.float64))
    expected = brute_force(cosine, roughness)
    assert split.scale.item() == pytest.approx(expected[0], abs=0.006)
    assert split.bias.item() == pytest.approx(expected[1], abs=0.006)


def test_limits() -> None:
    cosine = torch.linspace(0.02, 1.0, 40)
    split = brdf.split_sum(cosine, torch.zeros(40))
    fresnel = (1 - cosine) ** 5  # a perfect mirror is Schlick's term itself
    torch.testing.assert_close(split.bias, fresnel, atol=4e-3, rtol=0)
    torch.testing.assert_close(split.scale, 1 - fresnel, atol=4e-3, rtol=0)
    split_sum_table = brdf.split_sum_table()[..., :2]
    assert np.isfinite(split_sum_table).all() and (split_sum_table >= 0).all()
    assert (split_sum_table.sum(axis=-1) <= 1 + 1e-5).all()  # no energy is made
    # α = 1 head-on, exactly: the albedo of uniform GGX is 1 − ln 2 … by ∫ 2 n·l/(1 + n·l) over the head-on lobe, B is small.
    assert split_sum_table[-1, -1].sum() == pytest.approx(brute_force(1 - 1e-9, 1.0)[0] + brute_force(1 - 1e-9, 1.0)[1], abs=2e-3)


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
