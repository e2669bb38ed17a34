"""Mesh refinement against rendered normals.

Rendered depth is noisy at short wavelengths, rendered normals much less; positions are accurate at long wavelengths. Nehab et al.,
*Efficiently combining positions and normals for precise 3D geometry*, SIGGRAPH 2005: average the rendered normals of all views at each
vertex, then move vertices along them so that every edge is as perpendicular as possible to the mean normal of its ends (exact for
circular arcs, so nothing shrinks), with a data term that keeps the positions. One sparse symmetric system, conjugate gradients.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gsbake.geometry.conjugate_gradients import conjugate_gradients
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.meshing.cleanup import Faces, Vertices
from gsbake.meshing.depth_views import DepthView, Floats
from gsbake.shape_refinement.surface import Surface


class NormalAccumulator:
    """Weighted mean of the views' normals at `vertices` (v, 3); `add` takes one view at a time."""

    def __init__(self, vertices: Vertices, tolerance: float) -> None:
        self._vertices = np.ascontiguousarray(vertices, np.float32)
        self._tolerance = np.float32(tolerance)
        self._sum = np.zeros((len(vertices), 3), np.float32)
        self._weight = np.zeros(len(vertices), np.float32)

    def add(self, view: DepthView, normal: Floats) -> None:
        """Add a view's normals (h, w, 3; unit frame) at the vertices whose depth agrees with the view's to the tolerance."""
        camera = view.camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        pose = np.concatenate([camera.R, camera.t[:, None]], 1).astype(np.float32)
        maps = (view.inverse, view.weight, np.ascontiguousarray(normal, np.float32))
        fixed: tuple[Any, ...] = (self._vertices, pose, intrinsics, *maps, self._tolerance, self._sum, self._weight)
        run_chunks(lambda start, stop: _accumulate(start, stop, *fixed), len(self._vertices))

    def normals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit normals (v, 3), 0 for unobserved vertices, and their agreement (v,): 1 = equal in all views, 0 = unobserved."""
        length = np.linalg.norm(self._sum, axis=1)
        unit = self._sum / np.maximum(length, 1e-12)[:, None]
        agreement = np.where(self._weight > 0, length / np.maximum(self._weight, 1e-12), 0)
        return unit.astype(np.float64), agreement.astype(np.float64)


def integrate_normals(
    vertices: Vertices,
    faces: Faces,
    target: NDArray[np.float64],
    confidence: NDArray[np.float64],
    wavelength: float,
    max_displacement: float,
) -> Vertices:
    """Vertices (v, 3) moved along the `target` normals (v, 3) with `confidence` (v,) in 0..1 to agree with them.

    Detail below `wavelength` (world units) comes from the normals, above it from the positions. No vertex moves farther than
    `max_displacement`.
    """
    if len(faces) == 0 or wavelength <= 0 or not np.ptp(vertices[np.unique(faces)], axis=0).any():
        return vertices
    surface = Surface(len(vertices), faces)
    current = surface.normals(vertices)
    alignment = (current * target).sum(1)
    confidence = np.where(alignment > 0.3, confidence, 0.0)  # such a normal belongs to another surface
    normal = np.where((confidence > 0)[:, None], target, current)
    a, b = surface.edges.T
    mean_normal = normal[a] + normal[b]
    mean_normal /= np.maximum(np.linalg.norm(mean_normal, axis=1, keepdims=True), 1e-12)
    edge_vector = vertices[a] - vertices[b]
    # Slopes, not heights: short edges have the same weight as long ones, except very short ones, whose slope is uncertain.
    length = np.linalg.norm(edge_vector, axis=1)
    mean_length = float(length.mean())
    # A wave of that length rises by 2π · edge / wavelength of its amplitude per edge along it. Over three edges per vertex, most of them
    # oblique, the squares sum to 2/3 of that: with the inverse as weight such a wave is halved.
    edge_weight = 1.5 * (wavelength / (2 * np.pi * np.maximum(length, 0.3 * mean_length))) ** 2 * np.minimum(confidence[a], confidence[b])
    residual = (edge_vector * mean_normal).sum(1)
    coefficient_a, coefficient_b = (normal[a] * mean_normal).sum(1), (normal[b] * mean_normal).sum(1)
    n, edge_rows = len(vertices), np.arange(len(a))
    gradient = sparse.csr_matrix(
        (np.concatenate([coefficient_a, -coefficient_b]), (np.concatenate([edge_rows, edge_rows]), np.concatenate([a, b]))),
        shape=(len(a), n),
    )
    weighted = sparse.diags(edge_weight) @ gradient
    system = (sparse.identity(n) + gradient.T @ weighted).tocsr()
    displacement = conjugate_gradients(system, -(weighted.T @ residual), 1e-3, 200)
    return vertices + np.clip(displacement, -max_displacement, max_displacement)[:, None] * normal


@kernel(
    "i8, i8, f4[:, ::1], f4[:, ::1], f4[::1], f4[:, ::1], f4[:, ::1], f4[:, :, ::1], f4, f4[:, ::1], f4[::1]",
    nogil=True, error_model="numpy",
)
def _accumulate(
    start: int,
    stop: int,
    vertices: Any,
    pose: Any,
    intrinsics: Any,
    inverse: Any,
    weight: Any,
    normal: Any,
    tolerance: Any,
    out: Any,
    weight_total: Any,
) -> None:
    """Add bilinear normals of the pixels that observe each vertex."""
    height, width = inverse.shape
    for n in range(start, stop):
        x, y, z = vertices[n, 0], vertices[n, 1], vertices[n, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if depth < np.float32(1e-4):
            continue
        u = intrinsics[0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + intrinsics[2]
        v = intrinsics[1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + intrinsics[3]
        left, top = int(np.floor(u - np.float32(0.5))), int(np.floor(v - np.float32(0.5)))
        fu, fv = u - np.float32(0.5) - left, v - np.float32(0.5) - top
        for dv in range(2):
            for du in range(2):
                col, row = left + du, top + dv
                if col < 0 or row < 0 or col >= width or row >= height or inverse[row, col] <= 0:
                    continue
                if abs(np.float32(1) / inverse[row, col] - depth) > tolerance:
                    continue
                pixel_weight = weight[row, col] * (fu if du else np.float32(1) - fu) * (fv if dv else np.float32(1) - fv)
                out[n, 0] += pixel_weight * normal[row, col, 0]
                out[n, 1] += pixel_weight * normal[row, col, 1]
                out[n, 2] += pixel_weight * normal[row, col, 2]
                weight_total[n] += pixel_weight
