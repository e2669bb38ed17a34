"""One Gauss–Newton step: displacements along the normals from the rows of parallax, reflections and silhouettes, and priors.

    H = Σ J_d² + ∇ᵀ T ∇ + contour rows + priors,      T = Σ J_∇ J_∇ᵀ

Parallax is a diagonal, reflections see the gradient of the displacement, so they add a stiffness matrix with the tensor T; the rows that
couple both are left out. Priors keep a step smooth, and hold the total move near 0 where the start explains the photos: their weights
redescend with the move, 1/(1 + q²), and are released where the residual is worth more than a pixel of parallax.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from gsbake.kernels.threads import run_chunks
from gsbake.shape_refinement.appearance import Appearance, Geometry
from gsbake.shape_refinement.reflection_kernel import gauss_newton_rows
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Doubles, Floats, VertexSamples
from gsbake.shape_refinement.surface import Surface, tangents


@dataclass(frozen=True)
class StepOptions:
    """Weights of a step. Angles in degrees, distances in pixels."""

    #: Share of the information of the samples that counts: errors of neighbouring vertices and photos are correlated.
    independent: float = 0.2
    #: Standard deviations of a step: bend per edge, slope, move.
    bend: float = 6.0
    slope: float = 40.0
    move: float = 5.0
    #: Standard deviations of the total move: distance, and bend per edge.
    total_move: float = 0.5
    total_bend: float = 2.0
    #: Parallax that the residual must be worth for the total move to be free.
    release: float = 1.0
    #: Longest step.
    most: float = 1.5
    #: Standard deviation of a silhouette's contour point, and the residual beyond which it counts linearly (Huber).
    contour: float = 0.3
    contour_outlier: float = 0.7


@dataclass(frozen=True)
class Contour:
    """Contour points of all photos: `rows` (points, v) interpolate displacements, `target` (points,) what moves them to the masks, and
    `pixel` (points,) the size of a pixel there; `offset` is their median distance in pixels outward to the masks."""

    rows: sparse.csr_matrix
    target: Doubles
    pixel: Doubles
    offset: float


@dataclass(frozen=True)
class Step:
    """Displacements (v,) along the normals; `variance` (v,) of a sample for the next appearance; `relative_residual`, the root mean square
    of a photo's residual over the brightness."""

    displacement: Doubles
    variance: Floats
    relative_residual: float


def solve_step(
    surface: Surface, geometry: Geometry, samples: VertexSamples, robust: Floats, light: ReflectionMap, appearance: Appearance,
    total: Doubles | None, pixel: float, contour: Contour | None, since_contour: Doubles, options: StepOptions,
) -> Step:  # fmt: skip
    """The next displacements.

    `robust` (v, photos) gets the weights of the samples' residuals; `total` (v,) is the move so far, None for a step that
    nothing holds, `since_contour` (v,) the part since the
    contour points were found, `pixel` the size of a pixel at the object, all in the mesh's unit.
    """
    count, faces = surface.count, surface.faces
    frame = tangents(geometry.normals)
    hessian, gradient, residual = np.zeros((count, 4)), np.zeros((count, 3)), np.zeros((count, 2), np.float32)
    fixed = (
        geometry.vertices, geometry.normals, frame, geometry.centres, samples.colour, samples.slope, samples.weight, robust, light.tables(),
        appearance.kind, appearance.reflectance, appearance.diffuse, appearance.variance, 0.5 * np.pi / light.size,
        hessian, gradient, residual,
    )  # fmt: skip
    run_chunks(lambda start, stop: gauss_newton_rows(start, stop, *fixed), count)
    hessian *= options.independent
    gradient *= options.independent

    hat = surface.gradients(geometry.vertices)
    t1, t2 = frame[:, 0], frame[:, 1]
    share = 1 / surface.degree  # of a vertex in each of its faces
    outer = (
        hessian[:, 1, None, None] * t1[:, :, None] * t1[:, None]
        + hessian[:, 3, None, None] * t2[:, :, None] * t2[:, None]
        + hessian[:, 2, None, None] * (t1[:, :, None] * t2[:, None] + t2[:, :, None] * t1[:, None])
    ) * share[:, None, None]
    pull = (gradient[:, 1, None] * t1 + gradient[:, 2, None] * t2) * share[:, None]
    tensor = outer[faces].sum(1) + np.eye(3) * (0.5 / np.radians(options.slope) ** 2)
    matrix = surface.stiffness(hat @ tensor @ hat.transpose(0, 2, 1))
    right = -gradient[:, 0] - surface.sum_corners(np.einsum("fia,fa->fi", hat, pull[faces].sum(1)))

    edge = surface.mean_edge(geometry.vertices)
    worth = _worth(surface, samples, residual, appearance.importance, pixel)
    umbrella, bend = surface.umbrella, edge * np.radians(options.bend)
    matrix = matrix + surface.bending * (1 / bend**2) + sparse.diags(hessian[:, 0] + 1 / (options.move * pixel) ** 2)
    if total is not None:
        keep_move, keep_bend = _total_weights(surface, total, worth, pixel, edge, options)
        matrix = matrix + umbrella.T @ sparse.diags(keep_bend) @ umbrella + sparse.diags(keep_move)
        right -= keep_move * total + umbrella.T @ (keep_bend * (umbrella @ total))
    if contour is not None and len(contour.target):
        distance = (contour.target - contour.rows @ since_contour) / contour.pixel
        weight = np.minimum(1, options.contour_outlier / np.maximum(np.abs(distance), 1e-9)) / (options.contour * contour.pixel) ** 2
        weight *= min(1.0, 0.5 * count / len(distance))  # points between the same vertices say the same
        matrix = matrix + contour.rows.T @ sparse.diags(weight) @ contour.rows
        right += contour.rows.T @ (weight * distance * contour.pixel)
    matrix = matrix.tocsr()
    inverse = 1 / np.maximum(matrix.diagonal(), 1e-30)
    solution, _ = cg(matrix, right, rtol=1e-2, maxiter=150, M=LinearOperator(matrix.shape, matvec=lambda x: inverse * x.ravel()))
    limit = options.most * pixel
    seen = samples.weight.max(1, initial=0) > 0
    smooth = surface.averaged(np.stack([residual[:, 0] * seen, seen], 1), 8)
    relative = residual[seen, 0] * appearance.importance[seen]
    return Step(
        np.clip(solution, -limit, limit),
        np.asarray(smooth[:, 0] / np.maximum(smooth[:, 1], 1e-3) / 3, np.float32),
        float(np.sqrt(relative.mean())) if len(relative) else 0.0,
    )


def _worth(surface: Surface, samples: VertexSamples, residual: Floats, importance: Floats, pixel: float) -> Doubles:
    """How many pixels of parallax the residual is worth (v,), squared: its mean square over that of the slopes."""
    both = surface.averaged(np.stack([residual[:, 0], residual[:, 1] * pixel**2], 1) * importance[:, None], 12)
    return np.asarray(both[:, 0] / np.maximum(both[:, 1], 1e-12), np.float64)


def _total_weights(
    surface: Surface, total: Doubles, worth: Doubles, pixel: float, edge: float, options: StepOptions
) -> tuple[Doubles, Doubles]:
    """Weights (v,) of the total move and of its bend."""
    free = 1 / (1 + (worth / options.release**2) ** 2)
    out = []
    for value, deviation in ((total, options.total_move * pixel), (surface.umbrella @ total, edge * np.radians(options.total_bend))):
        square = surface.averaged((value / deviation)[:, None] ** 2, 6)[:, 0].astype(float)
        out.append(free / (1 + square) / deviation**2)
    return out[0], out[1]


def contour_rows(start: NDArray[np.int64], end: NDArray[np.int64], fraction: Doubles, count: int) -> sparse.csr_matrix:
    """Interpolation (points, count) at `fraction` of the edges from `start` to `end`."""
    rows = np.arange(len(start))
    values, columns = np.concatenate([1 - fraction, fraction]), np.concatenate([start, end])
    return sparse.csr_matrix((values, (np.concatenate([rows, rows]), columns)), (len(rows), count))
