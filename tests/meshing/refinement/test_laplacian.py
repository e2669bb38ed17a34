"""Screened Laplacian solver against least squares and a closed form."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import trimesh

from gsbake.meshing.refinement.laplacian import solve_screened_laplacian
from gsbake.meshing.refinement.normals import unique_edges


def test_equals_the_least_squares_solution() -> None:
    """The minimum of Σ wᵢ (δᵢ − tᵢ)² + λ Σ (δₐ − δ_b)² over the edges, from its stacked rows."""
    edges = unique_edges(trimesh.creation.icosphere(subdivisions=2).faces)
    count = int(edges.max()) + 1
    rng = np.random.default_rng(0)
    weight, target, smoothness = rng.uniform(0.01, 2, count), rng.normal(size=count), 0.7
    rows = np.zeros((len(edges), count))
    rows[np.arange(len(edges)), edges[:, 0]], rows[np.arange(len(edges)), edges[:, 1]] = 1, -1
    stacked = np.concatenate([np.diag(np.sqrt(weight)), np.sqrt(smoothness) * rows])
    truth = np.linalg.lstsq(stacked, np.concatenate([np.sqrt(weight) * target, np.zeros(len(edges))]), rcond=None)[0]
    np.testing.assert_allclose(solve_screened_laplacian(sparse.diags(weight), weight * target, edges, smoothness), truth, atol=1e-3)


def test_zero_prior_decays_exponentially() -> None:
    """Along a line δ falls by a constant factor q per edge with q + 1/q = 2 + pull / smooth."""
    pull, smoothness = 0.2, 0.5
    known = np.zeros(40)
    known[0] = 1.0
    found = solve_screened_laplacian(sparse.diags(known + pull), known, np.stack([np.arange(39), np.arange(1, 40)], 1), smoothness)
    total = 2 + pull / smoothness
    assert found[3] / found[2] == pytest.approx((total - np.sqrt(total**2 - 4)) / 2, rel=0.02)
