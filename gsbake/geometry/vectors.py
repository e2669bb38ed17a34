"""Operations on arrays of row vectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Minimum length of a vector with a direction.
MIN_LENGTH = 1e-20


def unit(vectors: NDArray[Any]) -> NDArray[Any]:
    """Normalise vectors (…, k), in their own float type; vectors below `MIN_LENGTH` become 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.where(length > MIN_LENGTH, vectors / np.maximum(length, MIN_LENGTH), 0.0))
