"""Displacements of a coarse mesh carried to a fine one of the same surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Doubles = NDArray[np.float64]

#: Coarse vertices whose displacements are averaged at a fine one, by the inverse square of their distance.
NEIGHBOURS = 6


def transfer_displacements(points: Doubles, normals: Doubles, coarse: Doubles, coarse_normals: Doubles, moved: Doubles) -> Doubles:
    """Displacements (n, 3) of `points` (n, 3) with unit `normals`: those of the nearest vertices of `coarse` (v, 3), moved to `moved`.

    Vertices whose normals look the other way lie on the other side of a thin wall and do not count; a point with no others stays.
    """
    distance, index = cKDTree(coarse).query(points, k=min(NEIGHBOURS, len(coarse)))
    distance, index = distance.reshape(len(points), -1), index.reshape(len(points), -1)
    agreement = np.einsum("nd,nkd->nk", normals, coarse_normals[index])
    smallest = np.finfo(float).tiny
    weight = np.maximum(agreement, 0) / np.maximum(distance / np.maximum(distance.max(1, keepdims=True), smallest), 1e-6) ** 2
    weight /= np.maximum(weight.sum(1, keepdims=True), smallest)
    return np.asarray(np.einsum("nk,nkd->nd", weight, (moved - coarse)[index]))
