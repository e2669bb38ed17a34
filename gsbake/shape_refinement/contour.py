"""Contour points of a mesh in a photo, and how far the mask's boundary is from them.

A mesh fused from depths is too small: surfels are rendered with a screen-space low-pass filter, so their silhouettes extend about a pixel
beyond the discs, and training moves the centres inward by as much. On a contour the normal is perpendicular to the viewing direction, so a
displacement δ along it moves the silhouette by δ f / z pixels.

Contour points are the zero crossings of n·v on the mesh's edges (Hertzmann, *Introduction to 3D non-photorealistic rendering*, SIGGRAPH
1999 course) that lie on the outline of the mesh in that view; each is compared with the mask's half level along the contour's normal in
the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.sampling import bilinear_at_pixels

Vertices = NDArray[np.float64]

#: Distance in pixels to either side of a contour point in which the mask's boundary is searched.
SEARCH_RADIUS = 5.0
#: Search steps per pixel.
SEARCH_STEPS = 4
#: Offset in pixels of the two rays that test whether a contour point lies on the outline.
OUTLINE_OFFSET = 1.0


@dataclass(frozen=True)
class ContourPoints:
    """Contour points on mesh edges: at `fraction` (n,) between the vertices `start` and `end` (n,); `offset` (n,) in pixels outward to the
    mask's boundary; `pixel` (n,) size of a pixel there in the unit frame."""

    start: NDArray[np.int64]
    end: NDArray[np.int64]
    fraction: NDArray[np.float64]
    offset: NDArray[np.float64]
    pixel: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.start)


def find_contour_points(
    caster: RayCaster, normals: Vertices, edges: NDArray[np.int64], camera: Camera, mask: NDArray[np.uint8]
) -> ContourPoints:
    """Contour points of the mesh in one view with the mask's boundary within `SEARCH_RADIUS`.

    `caster` contains the mesh; `normals` (v, 3) unit, outward; `mask` (h, w) 0..255.
    """
    vertices = caster.vertices
    facing = np.einsum("vk,vk->v", normals, camera.centre - vertices)
    a, b = facing[edges[:, 0]], facing[edges[:, 1]]
    crossing = (a > 0) != (b > 0)
    edges, a, b = edges[crossing], a[crossing], b[crossing]
    fraction = a / (a - b)
    point = vertices[edges[:, 0]] * (1 - fraction[:, None]) + vertices[edges[:, 1]] * fraction[:, None]
    normal = normals[edges[:, 0]] * (1 - fraction[:, None]) + normals[edges[:, 1]] * fraction[:, None]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    uv, z = camera.project(point)
    pixel = z / (0.5 * (camera.fx + camera.fy))
    displaced, _ = camera.project(point + normal * pixel[:, None])
    step = displaced - uv
    length = np.linalg.norm(step, axis=1)
    with np.errstate(invalid="ignore"):
        valid = (z > 0) & np.isfinite(uv).all(1) & (length > 0.5)
    edges, fraction, uv, pixel, step, length = edges[valid], fraction[valid], uv[valid], pixel[valid], step[valid], length[valid]
    step /= length[:, None]
    offset = _mask_boundary_offset(mask, uv, step)
    found = np.isfinite(offset)
    # On the outline a ray just outside misses the mesh and one just inside hits it; other contour points are interior or occluded.
    for side, hits in ((OUTLINE_OFFSET, False), (-OUTLINE_OFFSET, True)):
        rows = np.flatnonzero(found)
        found[rows] = caster.occluded(camera.centre[None], _rays(camera, uv[rows] + side * step[rows])) == hits
    return ContourPoints(edges[found, 0], edges[found, 1], fraction[found], offset[found] / length[found], pixel[found])


def _rays(camera: Camera, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ray directions (n, 3) in the unit frame through the pixel positions `uv` (n, 2)."""
    x, y = (uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], 1) @ camera.R


def _mask_boundary_offset(mask: NDArray[np.uint8], uv: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance (n,) in pixels from `uv` along unit `direction` (n, 2) to the nearest falling crossing of the mask's half level.

    NaN where there is none within `SEARCH_RADIUS` or the search leaves the image.
    """
    positions = np.arange(-SEARCH_RADIUS * SEARCH_STEPS, SEARCH_RADIUS * SEARCH_STEPS + 1) / SEARCH_STEPS
    if len(uv) == 0:
        return np.zeros(0)
    x, y = (uv[:, k, None] + positions * direction[:, k, None] - 0.5 for k in (0, 1))
    value = bilinear_at_pixels(mask, x, y).astype(np.float64) / 255 - 0.5
    inside, outside = value[:, :-1], value[:, 1:]
    crossing = (inside >= 0) & (outside < 0)
    crossing_position = positions[:-1] + inside / np.where(crossing, inside - outside, 1.0) / SEARCH_STEPS
    cost = np.where(crossing, np.abs(crossing_position), np.inf)
    nearest = cost.argmin(1)
    rows = np.arange(len(uv))
    height, width = mask.shape
    in_image = (x.min(1) >= 0) & (y.min(1) >= 0) & (x.max(1) <= width - 1) & (y.max(1) <= height - 1)
    return np.where(np.isfinite(cost[rows, nearest]) & in_image, crossing_position[rows, nearest], np.nan)
