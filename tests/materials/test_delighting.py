"""Shading taken out of colours: a known light over two paints comes back, and what cannot be told stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.materials.delighting import NOISE, PAPER, Irradiance, find_irradiance, without_shading

Floats = NDArray[np.float64]


def ball(count: int = 3000) -> Floats:
    """Points spread evenly over the unit sphere, which are their own normals."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)


def lamp(normal: Floats) -> Floats:
    """Irradiance over π of an even room of radiance .5 with a lamp in the direction (.6, 0, .8), written down without harmonics."""
    return 0.5 + 0.8 * np.maximum(normal @ np.array([0.6, 0.0, 0.8]), 0)


def paints(normal: Floats) -> Floats:
    """Stripes of brown and of a lighter blue."""
    stripe = np.sin(9 * normal[:, 0]) > 0
    return np.where(stripe[:, None], [0.3, 0.2, 0.1], [0.25, 0.4, 0.6])


def spread(values: Floats) -> float:
    """Standard deviation of logarithms: 0 where values differ by a factor alone."""
    return float(np.log(values).std())


def test_a_lamp_is_told_from_paint() -> None:
    normal = ball()
    paint, light = paints(normal), lamp(normal)
    open_share = np.where(normal[:, 1] > 0, 1.0, 0.6)
    seen = paint * (light * open_share)[:, None]
    found = find_irradiance(seen, normal, normal, open_share)
    base, level = without_shading(seen, normal, open_share, found)
    assert spread(seen / paint) > 0.35
    assert spread(base / paint) < 0.08
    shown = base * (level * found.at(normal) * open_share)[:, None]
    assert np.abs(shown / seen - 1).max() < 1e-5


def test_even_light_leaves_the_colours() -> None:
    normal = ball()
    paint = paints(normal)
    found = find_irradiance(paint, normal, normal, np.ones(len(normal)))
    base, level = without_shading(paint, normal, np.ones(len(normal)), found)
    assert np.abs(base / paint - 1).max() < NOISE and level == pytest.approx(1, abs=NOISE)


def test_no_light_makes_paint_brighter_than_paper() -> None:
    normal = ball()
    seen = np.full((len(normal), 3), 0.97)
    base, level = without_shading(seen, normal, np.ones(len(normal)), Irradiance(np.zeros(8)))
    assert np.allclose(base, PAPER, atol=1e-6) and level == pytest.approx(0.97 / PAPER)


def test_the_light_it_writes_is_the_one_it_divided_by() -> None:
    normal = ball(400)
    irradiance = Irradiance(np.array([0.2, -0.1, 0.3, 0.05, 0.0, 0.02, -0.03, 0.01]))
    light = irradiance.light(16, 1.7)
    diffuse = light.prefilter().diffuse(torch.as_tensor(normal, dtype=torch.float32)).detach().numpy()
    assert np.abs(diffuse / (1.7 * irradiance.at(normal))[:, None] - 1).max() < 0.02


def test_nothing_to_compare_is_even_light() -> None:
    for count in (0, 1, 3):
        normal = ball(3)[:count]
        found = find_irradiance(np.full((count, 3), 0.5), normal, 10 * normal, np.ones(count))
        assert not found.coefficients.any()
        assert without_shading(np.full((count, 3), 0.5), normal, np.ones(count), found)[0].shape == (count, 3)
