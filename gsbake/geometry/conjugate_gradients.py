"""Conjugate gradients for sparse systems, whose result does not depend on the number of threads.

SciPy's own takes its inner products from BLAS, which adds long vectors up in as many parts as it has threads. Preconditioned with the
diagonal (Hestenes & Stiefel, *Methods of conjugate gradients for solving linear systems*, J. Res. NBS 1952).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


def conjugate_gradients(matrix: Any, right: Doubles, tolerance: float, iterations: int, start: Doubles | None = None) -> Doubles:
    """x (n,) of `matrix` (n, n; sparse, symmetric, positive definite) · x = `right` (n,), from `start` (n,) or 0.

    Ends when the residual is `tolerance` times as long as `right`, or after some `iterations`.
    """
    solution = np.zeros(len(right)) if start is None else np.array(start, np.float64)
    right = np.asarray(right, np.float64)
    residual = right - matrix @ solution
    least = tolerance**2 * _dot(right, right)
    inverse = 1 / np.maximum(matrix.diagonal(), 1e-30)
    direction, before = np.zeros(len(right)), 0.0
    for _ in range(iterations):
        if _dot(residual, residual) <= least:
            break
        scaled = inverse * residual
        square = _dot(residual, scaled)
        direction = scaled + (square / before) * direction if before else scaled
        image = matrix @ direction
        curvature = _dot(direction, image)
        if curvature <= 0:  # singular, or too small for double precision
            break
        length = square / curvature
        solution, residual, before = solution + length * direction, residual - length * image, square
    return solution


def _dot(a: Doubles, b: Doubles) -> float:
    """Inner product, added up in one order."""
    return float(np.einsum("i,i->", a, b))
