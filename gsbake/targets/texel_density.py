"""Edge of the textures that the photos fill: no more texels than photos have pixels on the surface.

A texel's edge on the surface is compared with the footprint of a pixel of the nearest photo that faces it. The texture is halved while its
texels stay smaller than a pixel where photos look closest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.gltf.write import GltfMesh

#: Share of the surface whose detail is kept in full: the rest is seen more closely.
KEPT = 0.9
#: Least cosine between the surface's normal and the direction to a camera that sees it.
MIN_COSINE = 0.2
#: Points of the surface that are looked at.
POINTS = 20_000


def pixels_per_texel(mesh: GltfMesh, cameras: Sequence[Camera], edge: int) -> float:
    """Pixels of the nearest photo along the edge of a texel, at the quantile KEPT of the surface; 0 where no camera sees it."""
    corner, uv = mesh.position[mesh.faces].astype(np.float64), mesh.uv[mesh.faces].astype(np.float64)
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(cross, axis=1)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    texels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * edge * edge
    face = np.searchsorted(np.cumsum(area), (np.arange(POINTS) + 0.5) / POINTS * area.sum()).clip(0, len(area) - 1)
    length = np.sqrt(area[face] / np.maximum(texels[face], 1e-12))
    centre, normal = corner[face].mean(1), cross[face] / np.maximum(area[face], 1e-30)[:, None]
    found = np.max([_pixels_per_length(camera, centre, normal) for camera in cameras], 0) if cameras else np.zeros(len(face))
    return float(np.quantile(found * length, KEPT))


def texture_edge(edge: int, pixels: float) -> int:
    """The baked `edge`, halved while a texel covers at most one pixel; `pixels` is that of `pixels_per_texel`. At least 128."""
    while edge > 128 and 0 < 2 * pixels <= 1:
        edge, pixels = edge // 2, 2 * pixels
    return edge


def _pixels_per_length(camera: Camera, points: NDArray[Any], normal: NDArray[Any]) -> NDArray[np.float64]:
    """Pixels per length (n,) of a camera at points (n, 3) with normals (n, 3); 0 where it does not see them (occlusion is left out)."""
    pixel, depth = camera.project(points)
    towards = camera.centre - points
    cosine = np.einsum("nd,nd->n", towards, normal) / np.maximum(np.linalg.norm(towards, axis=1), 1e-30)
    seen = camera.in_view(pixel, depth) & (cosine > MIN_COSINE)
    return np.where(seen, np.sqrt(camera.fx * camera.fy) / np.maximum(depth, 1e-30), 0.0)
