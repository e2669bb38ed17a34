"""Shading in base colours: found from patches of equal colour, and moved to the light so that the irradiance has it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.materials.remaining_shading import (
    CHROMATICITY_SCALE,
    CHUNKS,
    NOISE_FLOOR,
    harmonics,
    normal_equations,
    remaining_shading,
    with_irradiance_factor,
)
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import prefilter_cube_map

TRUE = np.array([[0.3, -0.2, 0.1], [0.0, 0.1, 0.2], [-0.2, 0.1, 0.0], *np.zeros((4, 3)), [0.05, 0.1, -0.1]])


def ball(count: int = 3000) -> NDArray[np.float64]:
    normal = np.random.default_rng(1).normal(size=(count, 3))
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def two_colours(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two base colours in stripes that do not follow the normal."""
    stripe = np.sin(9 * np.arctan2(normal[:, 1], normal[:, 0]) + 7 * normal[:, 2])[:, None] > 0
    return np.where(stripe, [0.6, 0.2, 0.1], [0.1, 0.3, 0.4])


def test_shading_of_two_colours_is_found() -> None:
    normal = ball()
    shaded = two_colours(normal) * np.exp(harmonics(normal) @ TRUE)
    found = remaining_shading(shaded, normal, normal, np.random.default_rng(0))
    left = harmonics(normal) @ (found - TRUE)
    assert (left - left.mean(0)).std() < 0.02
    assert (harmonics(normal) @ TRUE).std() > 0.15


def test_strong_coloured_shading_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A warm sun against a blue sky: pairs across the terminator look like different base colours until the shading is known."""
    normal = ball()
    stripe = np.sin(9 * np.arctan2(normal[:, 1], normal[:, 0]) + 7 * normal[:, 2])[:, None] > 0
    shading = np.outer(normal[:, 0], [2.5, 1.6, 0.5])
    shaded = np.where(stripe, [0.5, 0.4, 0.3], [0.3, 0.42, 0.22]) * np.exp(shading)

    def error() -> float:
        left = harmonics(normal) @ remaining_shading(shaded, normal, normal, np.random.default_rng(0)) - shading
        return float((left - left.mean(0)).std())

    assert error() < 0.05
    monkeypatch.setattr("gsbake.materials.remaining_shading.WIDENING", 1.0)
    assert error() > 0.5


def test_base_colours_without_shading_stay() -> None:
    normal = ball()
    found = remaining_shading(two_colours(normal), normal, normal, np.random.default_rng(0))
    assert np.abs(harmonics(normal) @ found).max() < 0.02


@pytest.mark.parametrize("count", [0, 1, 2, 60])
def test_few_and_black_points(count: int) -> None:
    normal = ball(max(count, 1))[:count]
    found = remaining_shading(np.zeros((count, 3)), normal, normal, np.random.default_rng(0))
    assert np.isfinite(found).all() and np.abs(found).max(initial=0) < 1e-6


def test_the_light_gets_the_irradiance() -> None:
    normal = ball(500)
    normals = torch.from_numpy(normal.astype(np.float32))

    def irradiance(radiance: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(prefilter_cube_map(torch.from_numpy(radiance)).diffuse(normals).numpy())

    light = EnvironmentLight.from_function(lambda d: (1 + 3 * np.exp(6 * (d @ [0.6, 0.0, 0.8] - 1)))[:, None] * np.ones(3), 16)
    radiance = light.radiance().detach().numpy()
    wanted = np.exp(harmonics(normal) @ TRUE)
    wanted = irradiance(radiance) * wanted / wanted.mean(0)
    got = irradiance(with_irradiance_factor(radiance, TRUE, normal, irradiance))
    assert np.abs(got / wanted - 1).mean() < 0.02
    assert np.abs(irradiance(radiance) / wanted - 1).mean() > 0.1


@pytest.mark.parametrize("wider", [1.0, 3.0])
def test_normal_equations_equal_sums_of_arrays(wider: float) -> None:
    rng, points, pairs = np.random.default_rng(2), 50, 333
    first, second = rng.integers(points, size=(2, pairs))
    basis, logs = rng.normal(size=(points, 8)), rng.normal(scale=0.1, size=(points, 3))
    share, scale, found = rng.uniform(size=pairs), rng.uniform(0.1, 0.2, pairs), rng.normal(scale=0.01, size=(8, 3))
    arrays = np.column_stack([basis, logs]), share, scale, found
    matrices, rights, weights = (np.ones((CHUNKS, 3, *shape)) for shape in ((8, 8), (8,), ()))
    agreement = np.ones(CHUNKS)
    normal_equations(first, second, *(a.astype(np.float32) for a in arrays), wider, matrices, rights, weights, agreement)

    slope = basis[first] - basis[second]
    rest = logs[first] - logs[second] - slope @ found
    brightness = rest.mean(1)
    chromaticity = np.linalg.norm(rest - brightness[:, None], axis=1)
    similar = share * np.exp(-((chromaticity / (wider * CHROMATICITY_SCALE)) ** 2)) / (1 + (brightness / (wider * scale)) ** 2)
    assert np.isclose(agreement.sum(), similar.sum())
    for channel in range(3):
        weight = similar / np.maximum(np.abs(rest[:, channel]), wider * NOISE_FLOOR)
        matrix, right = (slope * weight[:, None]).T @ slope, slope.T @ (weight * rest[:, channel])
        assert np.allclose(matrices[:, channel].sum(0), matrix, atol=1e-6 * np.abs(matrix).max())  # float32 pairs
        assert np.allclose(rights[:, channel].sum(0), right, atol=1e-6 * np.abs(right).max())
        assert np.isclose(weights[:, channel].sum(), weight.sum())
