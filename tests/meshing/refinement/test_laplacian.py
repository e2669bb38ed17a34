"""Displacements spread over a mesh: what least squares says."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import trimesh

from gsbake.meshing.refinement.laplacian import spread
from gsbake.meshing.refinement.normals import edges_of


def test_is_the_least_squares_solution() -> None:
    """The minimum of Σ wᵢ (δᵢ − tᵢ)² + λ Σ (δₐ − δ_b)² over the edges, from its stacked rows."""
    edges = edges_of(trimesh.creation.icosphere(subdivisions=2).faces)
    count = int(edges.max()) + 1
    rng = np.random.default_rng(0)
    weight, target, smooth = rng.uniform(0.01, 2, count), rng.normal(size=count), 0.7
    rows = np.zeros((len(edges), count))
    rows[np.arange(len(edges)), edges[:, 0]], rows[np.arange(len(edges)), edges[:, 1]] = 1, -1
    stacked = np.concatenate([np.diag(np.sqrt(weight)), np.sqrt(smooth) * rows])
    truth = np.linalg.lstsq(stacked, np.concatenate([np.sqrt(weight) * target, np.zeros(len(edges))]), rcond=None)[0]
    np.testing.assert_allclose(spread(sparse.diags(weight), weight * target, edges, smooth), truth, atol=1e-3)


def test_a_pull_to_zero_lets_it_fade() -> None:
    """Along a line δ falls by a constant factor q per edge with q + 1/q = 2 + pull / smooth."""
    pull, smooth = 0.2, 0.5
    known = np.zeros(40)
    known[0] = 1.0
    found = spread(sparse.diags(known + pull), known, np.stack([np.arange(39), np.arange(1, 40)], 1), smooth)
    both = 2 + pull / smooth
    assert found[3] / found[2] == pytest.approx((both - np.sqrt(both**2 - 4)) / 2, rel=0.02)
