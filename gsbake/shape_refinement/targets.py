"""Measured displacements that a step shall reach: of contour points to the masks, of patches of photos that correlate best."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.shape_refinement.contour import find_contour_points
from gsbake.shape_refinement.surface import Doubles, Surface

#: Standard deviation in pixels of a contour point, and the residual beyond which it counts linearly (Huber).
CONTOUR_DEVIATION, CONTOUR_OUTLIER = 0.3, 0.7


@dataclass(frozen=True)
class Targets:
    """Displacements along the normals: `rows` (m, v) interpolate them at measured points, `target` (m,) is what they should be, with
    `information` (m,) per square length. Residuals over `outlier` (m,) count linearly (Huber)."""

    rows: sparse.csr_matrix
    target: Doubles
    information: Doubles
    outlier: Doubles

    @staticmethod
    def none(count: int) -> Targets:
        """No target for a mesh of `count` vertices."""
        return Targets(vertex_rows(np.zeros(0, np.int64), count), *np.zeros((3, 0)))

    def moved(self, displacement: Doubles) -> Targets:
        """What is left after the vertices moved by `displacement` (v,)."""
        return replace(self, target=self.target - self.rows @ displacement)

    def weights(self) -> Doubles:
        """Weight (m,) of each target."""
        return self.information * np.minimum(1, self.outlier / np.maximum(np.abs(self.target), 1e-9 * self.outlier))

    def system(self) -> tuple[sparse.csr_matrix, Doubles]:
        """Matrix (v, v) and right side (v,) of the normal equations."""
        weight = self.weights()
        return self.rows.T @ sparse.diags(weight) @ self.rows, self.rows.T @ (weight * self.target)


def contour_targets(
    surface: Surface, vertices: Doubles, masks: Iterable[tuple[Camera, NDArray[np.uint8] | None]], threads: int
) -> tuple[Targets, float]:
    """Targets of the mesh's contour points in all masks, and their median distance in pixels outward to the masks."""
    caster, normals = RayCaster(vertices, surface.faces, threads), surface.normals(vertices)
    parts = [find_contour_points(caster, normals, surface.edges, camera, mask) for camera, mask in masks if mask is not None]
    if not parts:
        return Targets.none(surface.count), 0.0
    start, end = (np.concatenate([getattr(part, name) for part in parts]) for name in ("start", "end"))
    fraction, offset, pixel = (np.concatenate([getattr(part, name) for part in parts]) for name in ("fraction", "offset", "pixel"))
    count = len(offset)
    share = min(1.0, 0.5 * surface.count / max(count, 1))  # points between the same vertices say the same
    rows = interpolation(start, end, fraction, surface.count)
    return (
        Targets(rows, offset * pixel, share / (CONTOUR_DEVIATION * pixel) ** 2, CONTOUR_OUTLIER * pixel),
        float(np.median(offset)) if count else 0.0,
    )


def interpolation(start: NDArray[np.int64], end: NDArray[np.int64], fraction: Doubles, count: int) -> sparse.csr_matrix:
    """Interpolation (points, count) at `fraction` of the edges from `start` to `end`."""
    rows = np.arange(len(start))
    values, columns = np.concatenate([1 - fraction, fraction]), np.concatenate([start, end])
    return sparse.csr_matrix((values, (np.concatenate([rows, rows]), columns)), (len(rows), count))


def vertex_rows(vertices: NDArray[np.int64], count: int) -> sparse.csr_matrix:
    """Rows (m, count) that pick the displacements of `vertices` (m,)."""
    return sparse.csr_matrix((np.ones(len(vertices)), (np.arange(len(vertices)), vertices)), (len(vertices), count))


def add_systems(targets: Sequence[Targets], count: int) -> tuple[sparse.csr_matrix, Doubles]:
    """Sum (count, count) and (count,) of the normal equations of all targets."""
    matrix, right = sparse.csr_matrix((count, count)), np.zeros(count)
    for target in targets:
        if len(target.target):
            part, side = target.system()
            matrix, right = matrix + part, right + side
    return matrix, right
