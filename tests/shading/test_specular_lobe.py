"""The lobes that imitate GGX at an angle against its own density, and the committed table against a new fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbake.imaging.srgb import encode
from gsbake.shading import brdf, cubemap
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.specular_lobe import ROOT_COSINE, ROUGHNESS, fit_lobe, ggx_density, lobe_table, prefiltered_density
from gsbake.shading.split_sum import shade
from tests.support.slow import slow


def test_density_integrates_to_the_directional_albedo() -> None:
    """∫ GGX n·l against A + B, which `test_brdf` compares with brute force over half-vectors."""
    light, area = cubemap.directions(128).reshape(-1, 3).astype(np.float64), cubemap.solid_angles(128).ravel()
    for roughness, cosine in ((0.3, 0.5), (0.6, 0.2), (0.9, 0.8)):
        bright = brdf.directional_albedo(np.array([cosine]), np.array([roughness**2]))[0, :2].sum()
        assert ggx_density(light, roughness, cosine) @ area == pytest.approx(float(bright), abs=0.01)


def test_prefiltered_lobe_is_that_of_normal_incidence() -> None:
    """D(h) n·l for n = v, up to a constant, textbook formula."""
    theta = np.linspace(0, 1.5, 20)
    light = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], 1)
    squared = 0.4**4
    expected = np.cos(theta) * squared / (np.cos(theta / 2) ** 2 * (squared - 1) + 1) ** 2
    found = prefiltered_density(light, 0.4, np.array([0.0, 0, 1]))
    np.testing.assert_allclose(found / found[0], expected / expected[0], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("root", [0.5, 0.8])
def test_table_is_what_the_fit_finds(root: float) -> None:
    start = None
    for roughness in ROUGHNESS:
        lobe, start = fit_lobe(roughness, root**2, start)
        at = lobe_table(np.array([roughness]), np.array([root]))[0]
        assert [lobe.share, lobe.roughness, lobe.mirror] == pytest.approx(at, abs=2e-3)


def test_limits() -> None:
    for root in (0.2, 0.6, 1.0):
        np.testing.assert_allclose(lobe_table(np.array([0.0]), np.array([root]))[0], [0, 0, 1])  # the mirror direction
    rows = lobe_table(np.repeat(ROUGHNESS[:9], len(ROOT_COSINE)), np.tile(ROOT_COSINE, 9))
    assert (rows[:, :2] > 0).all() and (rows[:, :2] < 1).all()
    head_on = lobe_table(np.array(ROUGHNESS[:6]), np.ones(6))
    np.testing.assert_allclose(head_on[:, 1], ROUGHNESS[:6], rtol=0.03)  # there the prefiltered lobe is the right one
    assert (np.diff(head_on[1:, 0]) > 0).all()


@pytest.mark.parametrize(
    ("roughness", "cosine", "ratio"), [(0.2, 0.3, 0.8), slow(0.3, 0.5, 0.75), slow(0.45, 0.4, 0.4), slow(0.6, 0.7, 0.5), (0.8, 0.3, 0.2)]
)
def test_metal_under_a_lamp_is_nearer_to_ggx_than_one_lobe(roughness: float, cosine: float, ratio: float) -> None:
    """Displayed shading of a white metal under a lamp in many directions: the exact sum, `shade`, and the prefiltered lobe alone."""
    fine, area = cubemap.directions(192).reshape(-1, 3).astype(np.float64), cubemap.solid_angles(192).ravel()
    truth = ggx_density(fine, roughness, cosine)
    normal, view = torch.tensor([[0.0, 0, 1]]), torch.tensor([[float(np.sqrt(1 - cosine**2)), 0, cosine]])
    white, one = torch.ones(1, 3), torch.ones(1)
    mirror = np.array([-np.sqrt(1 - cosine**2), 0, cosine])
    single = prefiltered_density(fine, roughness, mirror)
    errors = []
    for toward in mirror + np.random.default_rng(0).normal(0, 1.5 * roughness, (25, 3)):
        axis = toward / np.linalg.norm(toward)
        lamp = 3 * np.exp(60 * (fine @ axis - 1))
        tables = EnvironmentLight.from_function(lambda at, a=axis: np.repeat(3 * np.exp(60 * (at @ a - 1))[:, None], 3, 1), 32).prefilter()
        exact = truth @ (lamp * area) / (truth @ area)
        found = float(shade(normal, view, white, roughness * one, one, tables.detach())[0, 0])
        alone = single @ (lamp * area) / (single @ area)
        errors.append(np.diff(encode(np.clip([[exact, found], [exact, alone]], 0, 1)))[:, 0])
    error, before = np.square(errors).mean(0)
    assert error < ratio * before
