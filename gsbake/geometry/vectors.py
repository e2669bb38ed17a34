"""Vectors as rows of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Vectors no longer than this have no direction.
SHORTEST = 1e-20


def unit(vectors: NDArray[Any]) -> NDArray[Any]:
    """Vectors (…, k) at unit length, in their own float type; one without a direction becomes 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.where(length > SHORTEST, vectors / np.maximum(length, SHORTEST), 0.0))
