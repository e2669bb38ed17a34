"""Whether photos differ in exposure: do parts of the surface that face different ways see the same gains?

An exposure scales all of a photo. A reflection brightens what faces one way, so a photo's gains on parts that face other ways are
independent of it, but for one thing: photos from above see the ground in everything, photos from below the sky. So gains are solved on each
of DIRECTIONS cells of normals, what is linear in the direction of the camera is removed, and the correlation of what is left, between cells
that face ways MIN_ANGLE apart, is that share of its variance which all of a photo has in common: the intraclass correlation of Fisher,
*Statistical methods for research workers*, 1925. Surface near edges is left out, where a pixel shows both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.surfels.initialisation import fibonacci_sphere
from gsbake.texturing.view_fusion import MIN_TEXELS, solve_gains

Doubles = NDArray[np.float64]

#: Cells of normals, and the least angle in degrees between two that are compared.
DIRECTIONS, MIN_ANGLE = 24, 45.0
#: Near an edge is what has, among so many points within this share of the diagonal, one whose normal has a smaller cosine with its own.
NEIGHBOURS, EDGE_RADIUS, EDGE_COSINE = 24, 0.02, 0.8
#: Samples of a photo that a cell needs, and photos that a pair of cells needs.
MIN_SAMPLES, MIN_COMMON = 40, 4
#: Weight of the prior 0 on the linear part, in samples of gains.
PRIOR = 0.1


@dataclass(frozen=True)
class Agreement:
    """`share` of the variance of gains that all parts of a photo have in common (1: exposures alone; 0 or less: reflections alone), its
    standard `error`, and the number of `pairs` of cells it is from."""

    share: float
    error: float
    pairs: int


def exposure_agreement(
    logs: Doubles, view: NDArray[np.int64], position: NDArray[Any], normal: NDArray[Any], centres: Doubles
) -> Agreement | None:
    """How far the gains of photos agree between parts of the surface; None where no parts can be compared, as on a thin sheet.

    `logs` (n, keep) are logarithms of the brightness of surface points at `position` (n, 3), which have the unit `normal` (n, 3), in the
    photos `view` (n, keep), NaN where there is none. `centres` (photos, 3) are those of the cameras.
    """
    if len(position) < MIN_TEXELS:
        return None
    inner = ~_near_edges(np.asarray(position, np.float64), np.asarray(normal, np.float64))
    cell = np.where(inner, (normal @ fibonacci_sphere(DIRECTIONS).T).argmax(1), -1)
    gains = np.full((DIRECTIONS, len(centres)), np.nan)
    facing = np.zeros((DIRECTIONS, 3))
    for k in range(DIRECTIONS):
        mine = cell == k
        if mine.sum() < MIN_TEXELS:
            continue
        seen = np.bincount(view[mine][np.isfinite(logs[mine])], minlength=len(centres))
        solved = np.log(solve_gains(logs[mine][..., None], view[mine], len(centres))[:, 0])
        gains[k] = np.where(seen >= MIN_SAMPLES, solved, np.nan)
        facing[k] = normal[mine].sum(0)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    direction = centres - np.mean(position, axis=0)
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    return _intraclass(_without_linear_part(gains, direction), facing)


def _near_edges(position: Doubles, normal: Doubles) -> NDArray[np.bool_]:
    """Points (n,) beside which the surface turns."""
    if len(position) <= NEIGHBOURS:
        return np.zeros(len(position), bool)
    radius = EDGE_RADIUS * float(np.linalg.norm(np.ptp(position, axis=0)))
    _, near = cKDTree(position).query(position, NEIGHBOURS, distance_upper_bound=radius)
    near = np.where(near < len(position), near, np.arange(len(position))[:, None])
    return np.asarray(np.einsum("nkd,nd->nk", normal[near], normal).min(1) < EDGE_COSINE)


def _without_linear_part(gains: Doubles, direction: Doubles) -> Doubles:
    """`gains` (cells, photos), NaN: unknown, without what is linear in the `direction` (photos, 3) of the camera in all cells."""
    cell, photo = np.nonzero(np.isfinite(gains))
    known = gains[cell, photo]
    of_cell = np.maximum(np.bincount(cell, minlength=len(gains)), 1)

    def centred(values: Doubles) -> Doubles:
        """Without the mean of each cell."""
        return values - (np.bincount(cell, values, len(gains)) / of_cell)[cell]

    rows = np.column_stack([centred(column) for column in direction[photo].T])
    slope = np.linalg.solve(rows.T @ rows + PRIOR * np.eye(3), rows.T @ centred(known))
    return np.asarray(gains - direction @ slope)


def _intraclass(gains: Doubles, facing: Doubles) -> Agreement | None:
    """The intraclass correlation of `gains` (cells, photos), NaN: unknown, between cells with the mean normals `facing` (cells, 3)."""
    cross, own, pairs = np.zeros(gains.shape[1]), np.zeros(gains.shape[1]), 0
    apart = facing @ facing.T < np.cos(np.radians(MIN_ANGLE))
    for a, b in zip(*np.nonzero(np.triu(apart, 1)), strict=True):
        common = np.isfinite(gains[a]) & np.isfinite(gains[b])
        if common.sum() < MIN_COMMON:
            continue
        first, second = (g[common] - g[common].mean() for g in (gains[a], gains[b]))
        cross[common] += first * second
        own[common] += 0.5 * (first**2 + second**2)
        pairs += 1
    if not own.sum() > 0:
        return None
    share = float(cross.sum() / own.sum())
    return Agreement(share, float(np.linalg.norm(cross - share * own) / own.sum()), pairs)
