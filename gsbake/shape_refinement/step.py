"""One Gauss–Newton step: displacements along the normals from the rows of parallax, reflections and measured targets, and priors.

    H = Σ J_d² + ∇ᵀ T ∇ + targets + priors,      T = Σ J_∇ J_∇ᵀ

Parallax is a diagonal, reflections see the gradient of the displacement, so they add a stiffness matrix with the tensor T; the rows that
couple both are left out. Priors keep a step smooth, and hold the total move near 0 where the start explains the photos: their weights
redescend with the move, 1/(1 + q²), and are released where the residual is worth more than a pixel of parallax.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from gsbake.geometry.conjugate_gradients import conjugate_gradients
from gsbake.kernels.threads import run_chunks
from gsbake.shape_refinement.appearance import Appearance, Geometry
from gsbake.shape_refinement.reflection_kernel import gauss_newton_rows
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Doubles, Floats, VertexSamples
from gsbake.shape_refinement.surface import Surface, tangents
from gsbake.shape_refinement.targets import Targets, add_systems


@dataclass(frozen=True)
class StepOptions:
    """Weights of a step. Angles in degrees, distances in pixels."""

    #: Share of the information of the samples that counts: errors of neighbouring vertices and photos are correlated.
    independent: float = 0.2
    #: Standard deviations of a step: curvature per edge, slope, move.
    curvature: float = 6.0
    slope: float = 40.0
    move: float = 5.0
    #: Standard deviations of the total move: distance, and curvature per edge.
    total_move: float = 1.0
    total_curvature: float = 2.0
    #: Parallax that the residual must be worth for the total move to be free.
    release: float = 1.0
    #: Longest step.
    most: float = 1.5


@dataclass(frozen=True)
class PhotoRows:
    """Normal equations of the photos at each vertex: `hessian` (v, 4) of displacement and of the gradient along the `frame` (v, 2, 3) (uu,
    uv, vv), `gradient` (v, 3); `worth` (v,), the square of how many pixels of parallax the residual is worth; `variance` (v,) of a sample
    for the next appearance; `relative_residual`, the root mean square of a photo's residual over the brightness."""

    frame: Doubles
    hessian: Doubles
    gradient: Doubles
    worth: Doubles
    variance: Floats
    relative_residual: float


def measure_rows(
    surface: Surface, geometry: Geometry, samples: VertexSamples, robust: Floats, light: ReflectionMap, appearance: Appearance,
    pixel: float,
) -> PhotoRows:  # fmt: skip
    """The photos' rows; `robust` (v, photos) gets the weights of the samples' residuals."""
    count, frame = surface.count, tangents(geometry.normals)
    hessian, gradient, residual = np.zeros((count, 4)), np.zeros((count, 3)), np.zeros((count, 2), np.float32)
    fixed = (
        geometry.vertices, geometry.normals, frame, geometry.centres, samples.colour, samples.slope, samples.weight, robust, light.tables(),
        appearance.kind, appearance.reflectance, appearance.diffuse, appearance.variance, 0.5 * np.pi / light.size,
        hessian, gradient, residual,
    )  # fmt: skip
    run_chunks(lambda start, stop: gauss_newton_rows(start, stop, *fixed), count)
    seen = samples.weight.max(1, initial=0) > 0
    both = surface.averaged(np.stack([residual[:, 0], residual[:, 1] * pixel**2], 1) * appearance.importance[:, None], 12)
    smooth = surface.averaged(np.stack([residual[:, 0] * seen, seen], 1), 8)
    relative = residual[seen, 0] * appearance.importance[seen]
    return PhotoRows(
        frame, hessian, gradient,
        np.asarray(both[:, 0] / np.maximum(both[:, 1], 1e-12), np.float64),
        np.asarray(smooth[:, 0] / np.maximum(smooth[:, 1], 1e-3) / 3, np.float32),
        float(np.sqrt(relative.mean())) if len(relative) else 0.0,
    )  # fmt: skip


def solve_step(
    surface: Surface, vertices: Doubles, pixel: float, targets: Sequence[Targets], options: StepOptions, photos: PhotoRows | None = None,
    total: Doubles | None = None,
) -> Doubles:  # fmt: skip
    """The next displacements (v,) of the `vertices` (v, 3) along their normals, at most `options.most` pixels.

    `pixel` is the size of a pixel at the object in the mesh's unit; `total` (v,) the move so far, which is held where `photos` are
    explained, or None for a step that nothing holds.
    """
    count, edge = surface.count, max(surface.mean_edge(vertices), 1e-6 * pixel)  # of a collapsed mesh
    hat = surface.gradients(vertices)
    matrix, right = add_systems(targets, count)
    matrix = matrix + surface.squared_umbrella * (1 / (edge * np.radians(options.curvature)) ** 2)
    diagonal = np.full(count, 1 / (options.move * pixel) ** 2)
    tensor = np.eye(3) * (0.5 / np.radians(options.slope) ** 2)
    if photos is not None:
        diagonal += options.independent * photos.hessian[:, 0]
        curvature, pull = _reflection_system(surface, photos)
        tensor = options.independent * curvature + tensor
        right -= options.independent * (photos.gradient[:, 0] + surface.sum_corners(np.einsum("fia,fa->fi", hat, pull)))
        if total is not None:
            move, curvature = _total_weights(surface, total, photos.worth, pixel, edge, options)
            matrix = matrix + surface.umbrella.T @ sparse.diags(curvature) @ surface.umbrella
            diagonal += move
            right -= move * total + surface.umbrella.T @ (curvature * (surface.umbrella @ total))
    matrix = (matrix + surface.stiffness(hat @ tensor @ hat.transpose(0, 2, 1)) + sparse.diags(diagonal)).tocsr()
    return np.clip(conjugate_gradients(matrix, right, 1e-2, 150), -options.most * pixel, options.most * pixel)


def _reflection_system(surface: Surface, photos: PhotoRows) -> tuple[Doubles, Doubles]:
    """Tensors (f, 3, 3) and gradients (f, 3) of the faces for the displacement's gradient: a vertex has a share in each of its faces."""
    share = 1 / surface.degree
    t1, t2 = photos.frame[:, 0], photos.frame[:, 1]
    uu, uv, vv = (photos.hessian[:, k, None, None] for k in (1, 2, 3))
    outer = uu * t1[:, :, None] * t1[:, None] + vv * t2[:, :, None] * t2[:, None]
    outer += uv * (t1[:, :, None] * t2[:, None] + t2[:, :, None] * t1[:, None])
    pull = photos.gradient[:, 1, None] * t1 + photos.gradient[:, 2, None] * t2
    faces = surface.faces
    return (outer * share[:, None, None])[faces].sum(1), (pull * share[:, None])[faces].sum(1)


def _total_weights(
    surface: Surface, total: Doubles, worth: Doubles, pixel: float, edge: float, options: StepOptions
) -> tuple[Doubles, Doubles]:
    """Weights (v,) of the total move and of its curvature; `worth` (v,) in square pixels."""
    free = 1 / (1 + (worth / options.release**2) ** 2)
    out = []
    for value, deviation in ((total, options.total_move * pixel), (surface.umbrella @ total, edge * np.radians(options.total_curvature))):
        square = surface.averaged((value / deviation)[:, None] ** 2, 6)[:, 0].astype(float)
        out.append(free / (1 + square) / deviation**2)
    return out[0], out[1]
