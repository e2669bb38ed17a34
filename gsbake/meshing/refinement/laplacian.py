"""Screened Laplacian solver that interpolates sparse displacements over a mesh: (D + λL) δ = b with the umbrella operator L (Kobbelt et
al., *Interactive multi-resolution modeling on arbitrary meshes*, SIGGRAPH 1998), by conjugate gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg


def solve_screened_laplacian(
    data: Any, right_side: NDArray[np.float64], edges: NDArray[np.int64], smoothness: float
) -> NDArray[np.float64]:
    """δ (n,) that solves (data + smoothness · L) δ = right_side.

    `data` (n, n), sparse and positive definite, contains the measurements and the zero prior; `edges` (e, 2) connect vertices. δᵀLδ hardly
    depends on how finely a surface is triangulated.
    """
    count = len(right_side)
    adjacency = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    adjacency = adjacency + adjacency.T
    laplacian = sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
    system = (data + smoothness * laplacian).tocsr()
    inverse = 1.0 / system.diagonal()
    solution, _ = cg(system, right_side, rtol=1e-4, maxiter=400, M=LinearOperator(system.shape, matvec=lambda x: inverse * x.ravel()))
    return np.asarray(solution, np.float64)
