"""Delighting: a known light over two albedos is recovered, and ambiguous input is unchanged."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.materials.remaining_shading import MAX_ALBEDO, NOISE_FLOOR, Irradiance, find_irradiance, remove_shading

Floats = NDArray[np.float64]


def sphere(count: int = 3000) -> Floats:
    """Uniform points on the unit sphere, which are their own normals."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)


def directional(normal: Floats) -> Floats:
    """Irradiance over π under uniform radiance .5 and a directional light from (.6, 0, .8), in closed form."""
    return 0.5 + 0.8 * np.maximum(normal @ np.array([0.6, 0.0, 0.8]), 0)


def stripes(normal: Floats) -> Floats:
    """Stripes of brown and of a lighter blue."""
    stripe = np.sin(9 * normal[:, 0]) > 0
    return np.where(stripe[:, None], [0.3, 0.2, 0.1], [0.25, 0.4, 0.6])


def log_deviation(values: Floats) -> float:
    """Standard deviation of logarithms: 0 where values differ by a factor alone."""
    return float(np.log(values).std())


def test_directional_light_is_separated_from_albedo() -> None:
    normal = sphere()
    albedo, light = stripes(normal), directional(normal)
    occlusion = np.where(normal[:, 1] > 0, 1.0, 0.6)
    observed = albedo * (light * occlusion)[:, None]
    found = find_irradiance(observed, normal, normal, occlusion)
    base, intensity = remove_shading(observed, normal, occlusion, found)
    assert log_deviation(observed / albedo) > 0.35
    assert log_deviation(base / albedo) < 0.08
    shown = base * (intensity * found.at(normal) * occlusion)[:, None]
    assert np.abs(shown / observed - 1).max() < 1e-5


def test_uniform_light_leaves_colours_unchanged() -> None:
    normal = sphere()
    albedo = stripes(normal)
    found = find_irradiance(albedo, normal, normal, np.ones(len(normal)))
    base, intensity = remove_shading(albedo, normal, np.ones(len(normal)), found)
    assert np.abs(base / albedo - 1).max() < NOISE_FLOOR and intensity == pytest.approx(1, abs=NOISE_FLOOR)


def test_albedo_is_limited_to_white_paper() -> None:
    normal = sphere()
    observed = np.full((len(normal), 3), 0.97)
    base, intensity = remove_shading(observed, normal, np.ones(len(normal)), Irradiance(np.zeros(8)))
    assert np.allclose(base, MAX_ALBEDO, atol=1e-6) and intensity == pytest.approx(0.97 / MAX_ALBEDO)


def test_environment_map_has_the_irradiance_divided_by() -> None:
    normal = sphere(400)
    irradiance = Irradiance(np.array([0.2, -0.1, 0.3, 0.05, 0.0, 0.02, -0.03, 0.01]))
    light = irradiance.light(16, 1.7)
    diffuse = light.prefilter().diffuse(torch.as_tensor(normal, dtype=torch.float32)).detach().numpy()
    assert np.abs(diffuse / (1.7 * irradiance.at(normal))[:, None] - 1).max() < 0.02


def test_without_pairs_light_is_uniform() -> None:
    for count in (0, 1, 3):
        normal = sphere(3)[:count]
        found = find_irradiance(np.full((count, 3), 0.5), normal, 10 * normal, np.ones(count))
        assert not found.coefficients.any()
        assert remove_shading(np.full((count, 3), 0.5), normal, np.ones(count), found)[0].shape == (count, 3)
