"""Ray casting on triangle meshes with Embree.

The mesh is normalised to the unit box before Embree (single precision) uses it, so precision does not depend on position or units;
distances are in the caller's units. Embree's binding releases the interpreter lock while tracing, so chunks of rays run on a thread pool.

Wald et al., *Embree: a kernel framework for efficient CPU ray tracing*, SIGGRAPH 2014.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray

from gsbake.geometry.cameras import Camera
from gsbake.system.limits import usable_processors

#: Rays per call of Embree: small enough for load balancing, large enough to amortise the call.
CHUNK = 1 << 16
#: Maximum distance of an unlimited ray in Embree.
UNLIMITED_DISTANCE = np.float32(1e30)


@dataclass(frozen=True)
class Hits:
    """First hits of n rays.

    `face` (n,) int32, -1 on a miss; `bary` (n, 3) float32 weights of the face's three corners, 0 on a miss;
    `distance` (n,) float32 in units of the direction's length, inf on a miss.
    """

    face: NDArray[np.int32]
    bary: NDArray[np.float32]
    distance: NDArray[np.float32]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Which rays hit (n,)."""
        return self.face >= 0


class RayCaster:
    """Ray queries on a mesh of `vertices` (v, 3) and `faces` (f, 3); without faces no ray hits.

    `threads` defaults to the number of available processors.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, threads: int | None = None) -> None:
        self.vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
        self.faces = np.ascontiguousarray(np.asarray(faces).reshape(-1, 3), np.int32)
        self._threads = threads or usable_processors()
        self._scene: Any = None
        self._centre, self._scale = np.zeros(3), 1.0
        if len(self.faces) == 0:
            return
        lower, upper = self.vertices.min(0), self.vertices.max(0)
        self._centre = (lower + upper) / 2
        self._scale = 1.0 / max(float((upper - lower).max()), 1e-30)
        normalised = np.ascontiguousarray((self.vertices - self._centre) * self._scale, np.float32)
        self._scene = EmbreeScene(robust=True)  # robust: rays through shared edges hit one of the two faces
        self._mesh = TriangleMesh(self._scene, normalised, self.faces)
        # The binding builds its acceleration structure on the first query: done here, before threads start.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """The nearest hit of rays from `origins` (n, 3) along `directions` (n, 3), which need not be unit length.

        Either may have one row, used for all rays.
        """
        o, d = self._rays(origins, directions)
        n = len(o)
        face = np.full(n, -1, np.int32)
        bary = np.zeros((n, 3), np.float32)
        distance = np.full(n, np.inf, np.float32)

        def trace(start: int) -> None:
            chunk = slice(start, min(start + CHUNK, n))
            found = self._scene.run(self._to_unit_box(o[chunk]), self._scale_directions(d[chunk]), output=True)
            hit = found["primID"] >= 0
            u, v = found["u"], found["v"]
            face[chunk] = found["primID"]
            bary[chunk] = np.where(hit[:, None], np.stack([1 - u - v, u, v], 1), 0)
            distance[chunk] = np.where(hit, found["tfar"], np.inf)

        self._each_chunk(trace, n)
        return Hits(face, bary, distance)

    def occluded(self, origins: ArrayLike, directions: ArrayLike, max_distance: float | None = None) -> NDArray[np.bool_]:
        """Whether each ray (n,) hits the mesh within `max_distance`, in units of the direction's length."""
        o, d = self._rays(origins, directions)
        n = len(o)
        out = np.zeros(n, np.bool_)
        limit = UNLIMITED_DISTANCE if max_distance is None else np.float32(max_distance)

        def trace(start: int) -> None:
            chunk = slice(start, min(start + CHUNK, n))
            limits = np.full(chunk.stop - chunk.start, limit, np.float32)  # Embree writes into it
            out[chunk] = self._scene.run(self._to_unit_box(o[chunk]), self._scale_directions(d[chunk]), dists=limits, query="OCCLUDED") >= 0

        self._each_chunk(trace, n)
        return out

    def points(self, hits: Hits) -> NDArray[np.float64]:
        """Positions (n, 3) of the hits; NaN on a miss."""
        if len(self.faces) == 0:
            return np.full((len(hits.face), 3), np.nan)
        out = np.einsum("nk,nkd->nd", hits.bary.astype(np.float64), self.vertices[self.faces[np.maximum(hits.face, 0)]])
        out[~hits.hit] = np.nan
        return out

    def visible_from(
        self, camera: Camera, points: NDArray[Any], normals: NDArray[Any], min_cosine: float, ray_offset: float
    ) -> NDArray[np.bool_]:
        """Mask (n,) of surface points (n, 3) with outward unit `normals` (n, 3) that are inside the image, unoccluded, and have a cosine
        above `min_cosine` between normal and viewing direction; rays start `ray_offset` (mesh units) along the normal."""
        pixel, z = camera.project(points)
        to_camera = camera.centre - points
        to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-12)
        visible = camera.in_view(pixel, z) & (np.einsum("nk,nk->n", to_camera, normals) > min_cosine)
        rows = np.flatnonzero(visible)
        visible[rows] = ~self.occluded(points[rows] + ray_offset * normals[rows], to_camera[rows])
        return visible

    def depth(self, camera: Camera) -> NDArray[np.float32]:
        """Depth map (h, w) of the mesh at the pixel centres of `camera`; 0 = no surface."""
        rays = camera.rays().reshape(-1, 3)  # depth z = 1 along each, so distances are depths
        hits = self.first_hit(camera.centre[None], rays)
        return np.where(hits.hit, hits.distance, np.float32(0)).reshape(camera.height, camera.width)

    def _rays(self, origins: ArrayLike, directions: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
        """Origins and directions broadcast to one row per ray."""
        o, d = np.asarray(origins).reshape(-1, 3), np.asarray(directions).reshape(-1, 3)
        n = max(len(o), len(d)) if min(len(o), len(d)) else 0
        return np.broadcast_to(o, (n, 3)), np.broadcast_to(d, (n, 3))

    def _to_unit_box(self, origins: NDArray[Any]) -> NDArray[np.float32]:
        return np.ascontiguousarray((origins - self._centre) * self._scale, np.float32)

    def _scale_directions(self, directions: NDArray[Any]) -> NDArray[np.float32]:
        # Scaled like the origins, so that the ray parameter is in the caller's units.
        return np.ascontiguousarray(directions * self._scale, np.float32)

    def _each_chunk(self, trace: Any, n: int) -> None:
        if self._scene is None or n == 0:
            return
        starts = range(0, n, CHUNK)
        if len(starts) == 1 or self._threads == 1:
            for start in starts:
                trace(start)
            return
        with ThreadPoolExecutor(min(self._threads, len(starts))) as pool:
            list(pool.map(trace, starts))
