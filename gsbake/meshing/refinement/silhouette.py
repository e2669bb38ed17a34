"""Moving a mesh along its normals until its silhouettes meet the masks.

Surfels are blended with a screen-space low-pass, so their pictures reach about a pixel beyond the discs' centres and training draws the
centres inward by as much; a mesh fused from their depths is too small all over. The masks tell how much: at the rim of a view the surface
normal is at right angles to the view, so a step δ along it moves the silhouette by δ f / z pixels.

Rims are the zero crossings of n·v on the mesh's edges (Hertzmann, *Introduction to 3D non-photorealistic rendering*, SIGGRAPH 1999 course)
that lie on the outline of the mesh in that view; each is compared with the mask's half level along the rim's normal in the image. The
displacements between rims follow by least squares: (AᵀWA + λL) δ = AᵀW t with the umbrella operator L, robust by Huber weights, in a few
Gauss-Newton rounds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.sampling import read_at
from gsbake.meshing.refinement.laplacian import spread
from gsbake.meshing.refinement.normals import edges_of, vertex_normals

Vertices = NDArray[np.float64]
Faces = NDArray[np.int32]

#: The mask's border is looked for this many pixels to either side of a rim.
REACH = 5.0
#: Steps per pixel of that search.
STEPS = 4
#: A ray this many pixels outside a rim must pass the mesh.
OUTLINE = 1.0
#: Residuals beyond this many pixels count less (Huber).
ROBUST = 0.7
#: Influence of one rim, as a share of the object's size: how far a displacement is carried over the surface.
CARRY = 0.012


@dataclass(frozen=True)
class Rims:
    """Points on mesh edges: between vertices `start` and `end` (n,), `share` (n,) of the way; `offset` (n,) pixels outward to the mask's
    border and `pixel` (n,) size of a pixel there in the unit frame."""

    start: NDArray[np.int64]
    end: NDArray[np.int64]
    share: NDArray[np.float64]
    offset: NDArray[np.float64]
    pixel: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.start)


@dataclass(frozen=True)
class Polished:
    """The moved `vertices` (v, 3); median offset of the rims from the masks in pixels before and after; number of rims, 0 when too few."""

    vertices: Vertices
    before: float
    after: float
    rims: int


def find_rims(caster: RayCaster, normals: Vertices, edges: NDArray[np.int64], camera: Camera, mask: NDArray[np.uint8]) -> Rims:
    """Rims of the mesh in one view that have the mask's border within reach.

    `caster` holds the mesh; `normals` (v, 3) unit, outward; `mask` (h, w) 0..255.
    """
    vertices = caster.vertices
    facing = np.einsum("vk,vk->v", normals, camera.centre - vertices)
    a, b = facing[edges[:, 0]], facing[edges[:, 1]]
    crossing = (a > 0) != (b > 0)
    edges, a, b = edges[crossing], a[crossing], b[crossing]
    share = a / (a - b)
    point = vertices[edges[:, 0]] * (1 - share[:, None]) + vertices[edges[:, 1]] * share[:, None]
    normal = normals[edges[:, 0]] * (1 - share[:, None]) + normals[edges[:, 1]] * share[:, None]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    uv, z = camera.project(point)
    pixel = z / (0.5 * (camera.fx + camera.fy))
    ahead, _ = camera.project(point + normal * pixel[:, None])
    step = ahead - uv
    length = np.linalg.norm(step, axis=1)
    with np.errstate(invalid="ignore"):
        fine = (z > 0) & np.isfinite(uv).all(1) & (length > 0.5)
    edges, share, uv, pixel, step, length = edges[fine], share[fine], uv[fine], pixel[fine], step[fine], length[fine]
    step /= length[:, None]
    offset = _border(mask, uv, step)
    found = np.isfinite(offset)
    # On the outline a ray just outside passes the mesh and one just inside hits it; elsewhere a rim is an inner contour or hidden.
    for side, hits in ((OUTLINE, False), (-OUTLINE, True)):
        rows = np.flatnonzero(found)
        found[rows] = caster.occluded(camera.centre[None], _rays(camera, uv[rows] + side * step[rows])) == hits
    return Rims(edges[found, 0], edges[found, 1], share[found], offset[found] / length[found], pixel[found])


def _rays(camera: Camera, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (n, 3) in the unit frame through the pixel positions `uv` (n, 2)."""
    x, y = (uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], 1) @ camera.R


def _border(mask: NDArray[np.uint8], uv: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance (n,) in pixels from `uv` along unit `direction` (n, 2) to the nearest place where the mask falls through one half.

    NaN where there is none within `REACH` or the line leaves the picture.
    """
    along = np.arange(-REACH * STEPS, REACH * STEPS + 1) / STEPS
    if len(uv) == 0:
        return np.zeros(0)
    x, y = (uv[:, k, None] + along * direction[:, k, None] - 0.5 for k in (0, 1))
    value = read_at(mask, x, y).astype(np.float64) / 255 - 0.5
    inside, outside = value[:, :-1], value[:, 1:]
    falls = (inside >= 0) & (outside < 0)
    place = along[:-1] + inside / np.where(falls, inside - outside, 1.0) / STEPS
    cost = np.where(falls, np.abs(place), np.inf)
    best = cost.argmin(1)
    rows = np.arange(len(uv))
    height, width = mask.shape
    kept = (x.min(1) >= 0) & (y.min(1) >= 0) & (x.max(1) <= width - 1) & (y.max(1) <= height - 1)
    return np.where(np.isfinite(cost[rows, best]) & kept, place[rows, best], np.nan)


def solve(rims: Rims, edges: NDArray[np.int64], count: int, reach: float) -> NDArray[np.float64]:
    """Displacements (count,) along the vertex normals, in the unit frame, that bring the rims to the masks and vary slowly between them.

    `reach` is how far, in edges, a rim's displacement is carried.
    """
    rows = np.arange(len(rims))
    weight = np.where(np.abs(rims.offset) <= ROBUST, 1.0, ROBUST / np.maximum(np.abs(rims.offset), 1e-12))
    measure = sparse.csr_matrix(
        (np.concatenate([1 - rims.share, rims.share]), (np.concatenate([rows, rows]), np.concatenate([rims.start, rims.end]))),
        shape=(len(rims), count),
    )
    density = max(len(rims) / count, 1e-6)
    data = measure.T @ sparse.diags(weight) @ measure + 1e-6 * sparse.identity(count)
    return spread(data, measure.T @ (weight * rims.offset * rims.pixel), edges, density * reach**2)


def polish(
    vertices: Vertices,
    faces: Faces,
    views: Callable[[], Iterable[tuple[Camera, NDArray[np.uint8]]]],
    rounds: int,
    threads: int,
) -> Polished:
    """Move the `vertices` (v, 3) of a mesh (unit frame, wound outward) until its silhouettes meet the masks.

    `views` is called once a round and gives cameras with their masks (h, w), 0..255. Fewer than 100 rims leave the mesh as it is.
    """
    edges = edges_of(faces)
    size = float(np.ptp(vertices, axis=0).max())
    mean_edge = float(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean())
    before = after = float("nan")
    found = 0
    for turn in range(rounds + 1):
        caster, normals = RayCaster(vertices, faces, threads), vertex_normals(vertices, faces)
        parts = [find_rims(caster, normals, edges, camera, mask) for camera, mask in views()]
        rims = Rims(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("start", "end", "share", "offset", "pixel")))
        if len(rims) < 100:
            break
        after, found = float(np.median(rims.offset)), len(rims)
        before = after if turn == 0 else before
        if turn == rounds:
            break
        vertices = vertices + normals * solve(rims, edges, len(vertices), CARRY * size / mean_edge)[:, None]
    return Polished(vertices, before, after, found)
