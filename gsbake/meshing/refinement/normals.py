"""Vertex positions that agree with the normals the views show.

Depth of splats is noisy at short wavelengths, their normals much less so; positions are right at long ones. Nehab et al., *Efficiently
combining positions and normals for precise 3D geometry*, SIGGRAPH 2005: gather the rendered normals of all views at each vertex, then move
vertices along them so that every edge lies as square as possible to the mean normal of its ends (exact for circular arcs, so
nothing shrinks), held back by a pull to where they were. One sparse symmetric system, conjugate gradients.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg

from gsbake.meshing.cleanup import Faces, Vertices
from gsbake.meshing.depth_views import DepthView, Floats
from gsbake.surfels.raster.threads import run_chunks


class NormalGather:
    """Weighted mean of the views' normals at `vertices` (v, 3); views stream through `add`."""

    def __init__(self, vertices: Vertices, tolerance: float) -> None:
        self._vertices = np.ascontiguousarray(vertices, np.float32)
        self._tolerance = np.float32(tolerance)
        self._sum = np.zeros((len(vertices), 3), np.float32)
        self._weight = np.zeros(len(vertices), np.float32)

    def add(self, view: DepthView, normal: Floats) -> None:
        """Add a view's normals (h, w, 3; unit frame) at the vertices that its depth shows, to within the tolerance along the ray."""
        camera = view.camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        pose = np.concatenate([camera.R, camera.t[:, None]], 1).astype(np.float32)
        maps = (view.inverse, view.weight, np.ascontiguousarray(normal, np.float32))
        fixed: tuple[Any, ...] = (self._vertices, pose, intrinsics, *maps, self._tolerance, self._sum, self._weight)
        run_chunks(lambda start, stop: _gather(start, stop, *fixed), len(self._vertices))

    def normals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit normals (v, 3), 0 where no view saw the vertex, and how well the views agree (v,): 1 = all alike, 0 = unseen."""
        length = np.linalg.norm(self._sum, axis=1)
        unit = self._sum / np.maximum(length, 1e-12)[:, None]
        agreement = np.where(self._weight > 0, length / np.maximum(self._weight, 1e-12), 0)
        return unit.astype(np.float64), agreement.astype(np.float64)


def vertex_normals(vertices: Vertices, faces: Faces) -> NDArray[np.float64]:
    """Area-weighted unit normals (v, 3)."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros_like(vertices)
    for axis in range(3):
        for corner in range(3):
            out[:, axis] += np.bincount(faces[:, corner], cross[:, axis], minlength=len(vertices))
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-20))


def edges_of(faces: NDArray[Any]) -> NDArray[np.int64]:
    """Each edge once, (e, 2), the smaller vertex first."""
    pairs = np.sort(np.asarray(faces)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    return np.unique(pairs[:, 0] << 32 | pairs[:, 1])[:, None] >> np.array([32, 0]) & 0xFFFFFFFF


def follow_normals(
    vertices: Vertices, faces: Faces, target: NDArray[np.float64], trust: NDArray[np.float64], reach: float, limit: float
) -> Vertices:
    """Vertices (v, 3) moved along the `target` normals (v, 3, weighted by `trust` (v,) in 0..1) to agree with them.

    Waves shorter than `reach` (world units) follow the normals, longer ones the positions. No vertex moves farther than `limit`.
    """
    if len(faces) == 0 or reach <= 0:
        return vertices
    own = vertex_normals(vertices, faces)
    agree = (own * target).sum(1)
    trust = np.where(agree > 0.3, trust, 0.0)  # a normal that contradicts the surface belongs to another one
    normal = np.where((trust > 0)[:, None], target, own)
    a, b = edges_of(faces).T
    middle = normal[a] + normal[b]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    span = vertices[a] - vertices[b]
    # Slopes count, not rises: a sliver's short edge speaks as loudly as a long one (to a point: its slope is less certain).
    length = np.linalg.norm(span, axis=1)
    typical = float(length.mean())
    # A wave as long as the reach rises by 2π · edge / reach of its amplitude per edge along it. Three edges per vertex, most of them
    # oblique, make that 2/3 in sum over squares: with its inverse such a wave is halved.
    strength = 1.5 * (reach / (2 * np.pi * np.maximum(length, 0.3 * typical))) ** 2 * np.minimum(trust[a], trust[b])
    tilt = (span * middle).sum(1)
    along_a, along_b = (normal[a] * middle).sum(1), (normal[b] * middle).sum(1)
    n, rows = len(vertices), np.arange(len(a))
    slope = sparse.csr_matrix(
        (np.concatenate([along_a, -along_b]), (np.concatenate([rows, rows]), np.concatenate([a, b]))), shape=(len(a), n)
    )
    weighted = sparse.diags(strength) @ slope
    system = (sparse.identity(n) + slope.T @ weighted).tocsr()
    scale = sparse.diags(1 / system.diagonal())
    shift, _ = cg(system, -(weighted.T @ tilt), rtol=1e-3, maxiter=200, M=scale)
    return vertices + np.clip(shift, -limit, limit)[:, None] * normal


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather(
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
    total: Any,
) -> None:
    """Bilinear normals where all four pixels show the vertex, the nearest pixel's otherwise."""
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
                share = weight[row, col] * (fu if du else np.float32(1) - fu) * (fv if dv else np.float32(1) - fv)
                out[n, 0] += share * normal[row, col, 0]
                out[n, 1] += share * normal[row, col, 1]
                out[n, 2] += share * normal[row, col, 2]
                total[n] += share
