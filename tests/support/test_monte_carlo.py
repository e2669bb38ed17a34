"""The Monte Carlo reference renderer against closed forms."""

from __future__ import annotations

import numpy as np

from tests.support.monte_carlo import render

UP = np.array([[0.0, 0.0, 1.0]])
WHITE, BLACK = np.ones((1, 3)), np.zeros((1, 3))


def test_lambert_under_a_linear_sky() -> None:
    """E / π of a + b z is a + 2/3 b n_z; the specular part of the dielectric is subtracted by a black surface."""

    def sky(directions: np.ndarray) -> np.ndarray:
        return np.asarray((0.5 + 0.3 * directions[:, 2])[:, None] * np.ones(3))

    both = [render(UP, UP, a, np.ones(1), np.zeros(1), sky, 4096) for a in (0.6 * WHITE, BLACK)]
    reflected = render(UP, UP, BLACK, np.ones(1), np.zeros(1), lambda d: np.ones((len(d), 3)), 4096)
    np.testing.assert_allclose(both[0] - both[1], 0.6 * (0.5 + 0.3 * 2 / 3) * (1 - reflected), rtol=0.01)


def test_white_furnace() -> None:
    view = np.array([[0.6, 0.0, 0.8]])
    for roughness in (0.15, 0.6, 0.9):  # light between microfacets: a white metal loses nothing
        metal = render(UP, view, WHITE, np.full(1, roughness), np.ones(1), lambda d: np.ones((len(d), 3)), 4096)
        np.testing.assert_allclose(metal, 1, atol=0.003)
    dielectric = render(UP, view, WHITE, np.full(1, 0.3), np.zeros(1), lambda d: np.ones((len(d), 3)), 4096)
    np.testing.assert_allclose(dielectric, 1, rtol=0.01)  # what the specular layer lets through is reflected
