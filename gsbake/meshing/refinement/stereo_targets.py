"""Displacements of a mesh's vertices to the depths that stereo confirmed.

A mesh is fused in voxels, and its rim drawn to the masks; both move what lies between by a fraction of a pixel. Where stereo matched photos
as fine as the mesh is refined in, its depths are the better measurement: planes that several photos agree on (`gsbake.mvs`), to about a
tenth of a pixel. As with patches, a vertex counts by majority: most of the photos that see it must have confirmed its depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.meshing.cleanup import Vertices
from gsbake.shape_refinement.surface import Surface, surface_area
from gsbake.shape_refinement.targets import Targets, vertex_rows

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Minimum cosine between normal and viewing direction of a measurement.
MIN_COSINE = 0.4
#: Standard deviation in pixels of what all photos say about a vertex together, as their depths were averaged, and the residual beyond which
#: a depth counts linearly (Huber).
DEVIATION, OUTLIER = 0.3, 0.6


@dataclass(frozen=True)
class StereoTargets:
    """Measures the way to stereo's depths, for `refine_shape`: `cameras`, and `depth(i)`: z-depth (h, w; 0 = none) and confidence of photo
    i at any size, or None. A depth within `tolerance` (world units) of the mesh is one of its surface; `pixel` is the size of a pixel
    there."""

    cameras: Sequence[Camera]
    depth: Callable[[int], tuple[Floats, Floats] | None]
    tolerance: float
    pixel: float
    threads: int

    def __call__(self, surface: Surface, vertices: Vertices) -> tuple[Targets, float]:
        """Targets at the vertices, and the share of those that a photo sees that most photos confirm."""
        if surface_area(vertices, surface.faces) == 0:
            return Targets.none(surface.count), 0.0
        count, normals = len(vertices), surface.normals(vertices)
        caster, ray_offset = RayCaster(vertices, surface.faces, self.threads), 0.5 * surface.mean_edge(vertices)
        seen, found = np.zeros(count), np.zeros(count)
        rows, target, confidence = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)]
        for index, camera in enumerate(self.cameras):
            visible = np.flatnonzero(caster.visible_from(camera, vertices, normals, MIN_COSINE, ray_offset))
            seen[visible] += 1
            if (maps := self.depth(index)) is None:
                continue
            way, certain = self._way(camera, vertices[visible], normals[visible], *maps)
            near = certain > 0
            found[visible[near]] += 1
            rows.append(visible[near])
            target.append(way[near])
            confidence.append(certain[near])
        row, certain = np.concatenate(rows), np.concatenate(confidence)
        majority = np.maximum(2 * found / np.maximum(seen, 1) - 1, 0)
        information = certain * majority[row] / found[row] / (DEVIATION * self.pixel) ** 2
        share = int((majority > 0).sum()) / max(int((seen > 0).sum()), 1)
        return Targets(vertex_rows(row, count), np.concatenate(target), information, np.full(len(row), OUTLIER * self.pixel)), share

    def _way(self, camera: Camera, points: Vertices, normals: Doubles, depth: Floats, confidence: Floats) -> tuple[Doubles, Doubles]:
        """Way (n,) along the normals from points (n, 3) in the photo to the depth there, and its confidence (n,); 0 where not all four
        pixels around a point have a depth of this surface."""
        uv, z = camera.project(points)
        height, width = depth.shape
        x, y = uv[:, 0] * (width / camera.width) - 0.5, uv[:, 1] * (height / camera.height) - 0.5
        left, top = np.clip(x.astype(np.int64), 0, width - 2), np.clip(y.astype(np.int64), 0, height - 2)
        right, down = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
        corners = np.stack([depth[top + j, left + i] for j in (0, 1) for i in (0, 1)])
        weights = np.stack([(down if j else 1 - down) * (right if i else 1 - right) for j in (0, 1) for i in (0, 1)])
        whole = (corners > 0).all(0) & (np.ptp(corners, axis=0) < self.tolerance)
        # The inverse depth of a plane is linear in the photo.
        difference = np.where(whole, 1 / (weights / np.where(corners > 0, corners, 1)).sum(0), np.inf) - z
        near = np.abs(difference) < self.tolerance
        way = np.where(near, difference, 0) / z * ((points - camera.centre) * normals).sum(1)
        return way, np.where(near, confidence[top, left], 0).astype(np.float64)
