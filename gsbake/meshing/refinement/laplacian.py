"""Displacements known here and there, spread over a mesh: (D + λL) δ = b with the umbrella operator L (Kobbelt et al., *Interactive
multi-resolution modeling on arbitrary meshes*, SIGGRAPH 1998), by conjugate gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg


def spread(data: Any, right: NDArray[np.float64], edges: NDArray[np.int64], smooth: float) -> NDArray[np.float64]:
    """δ (n,) that solves (data + smooth · L) δ = right.

    `data` (n, n) sparse, positive definite, holds what is measured and what pulls towards 0; `edges` (e, 2) link vertices. On a surface
    δᵀLδ hardly depends on how finely it is divided.
    """
    count = len(right)
    link = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    link = link + link.T
    umbrella = sparse.diags(np.asarray(link.sum(1)).ravel()) - link
    system = (data + smooth * umbrella).tocsr()
    inverse = 1.0 / system.diagonal()
    found, _ = cg(system, right, rtol=1e-4, maxiter=400, M=LinearOperator(system.shape, matvec=lambda x: inverse * x.ravel()))
    return np.asarray(found, np.float64)
