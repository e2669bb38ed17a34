"""Rays against a triangle mesh, on Embree.

The scene is shifted and scaled to the unit box before Embree (single precision) sees it, so meshes far from the origin or in odd
units lose nothing; distances come back in the caller's units. Embree's binding lets go of the interpreter lock while it traces,
so chunks of rays run on a small thread pool.

Wald et al., *Embree: a kernel framework for efficient CPU ray tracing*, SIGGRAPH 2014.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray

from gsbake.geometry.cameras import Camera

#: Rays per call of Embree: small enough that threads share the work evenly, large enough to hide the call.
CHUNK = 1 << 16
#: Embree's "no limit"; far beyond a scene of size one.
FAR = np.float32(1e30)


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
    """Ray queries on a mesh of `vertices` (v, 3) and `faces` (f, 3); a mesh without faces is hit by nothing.

    `threads` defaults to the processors this process may use.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, threads: int | None = None) -> None:
        self.vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
        self.faces = np.ascontiguousarray(np.asarray(faces).reshape(-1, 3), np.int32)
        allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self._threads = threads or allowed or 1
        self._scene: Any = None
        self._centre, self._scale = np.zeros(3), 1.0
        if len(self.faces) == 0:
            return
        lower, upper = self.vertices.min(0), self.vertices.max(0)
        self._centre = (lower + upper) / 2
        self._scale = 1.0 / max(float((upper - lower).max()), 1e-30)
        inner = np.ascontiguousarray((self.vertices - self._centre) * self._scale, np.float32)
        self._scene = EmbreeScene(robust=True)  # robust: rays through shared edges do not slip between the two faces
        self._mesh = TriangleMesh(self._scene, inner, self.faces)
        # The binding builds its tree on the first query; do it here, where no second thread can race it.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """The nearest hit of rays from `origins` (n, 3) along `directions` (n, 3), which need not be unit length.

        Either may have one row, used for all rays.
        """
        rays_o, rays_d = self._rays(origins, directions)
        n = len(rays_o)
        face = np.full(n, -1, np.int32)
        bary = np.zeros((n, 3), np.float32)
        distance = np.full(n, np.inf, np.float32)

        def trace(start: int) -> None:
            part = slice(start, min(start + CHUNK, n))
            found = self._scene.run(self._inner(rays_o[part]), self._direction(rays_d[part]), output=True)
            hit = found["primID"] >= 0
            u, v = found["u"], found["v"]
            face[part] = found["primID"]
            bary[part] = np.where(hit[:, None], np.stack([1 - u - v, u, v], 1), 0)
            distance[part] = np.where(hit, found["tfar"], np.inf)

        self._each_chunk(trace, n)
        return Hits(face, bary, distance)

    def occluded(self, origins: ArrayLike, directions: ArrayLike, max_distance: float | None = None) -> NDArray[np.bool_]:
        """Whether anything lies along each ray (n,), up to `max_distance` in units of the direction's length."""
        rays_o, rays_d = self._rays(origins, directions)
        n = len(rays_o)
        out = np.zeros(n, np.bool_)
        reach = FAR if max_distance is None else np.float32(max_distance)

        def trace(start: int) -> None:
            part = slice(start, min(start + CHUNK, n))
            limits = np.full(part.stop - part.start, reach, np.float32)  # Embree writes into it
            out[part] = self._scene.run(self._inner(rays_o[part]), self._direction(rays_d[part]), dists=limits, query="OCCLUDED") >= 0

        self._each_chunk(trace, n)
        return out

    def points(self, hits: Hits) -> NDArray[np.float64]:
        """Positions (n, 3) of the hits on their faces; not a number where the ray missed."""
        if len(self.faces) == 0:
            return np.full((len(hits.face), 3), np.nan)
        out = np.einsum("nk,nkd->nd", hits.bary.astype(np.float64), self.vertices[self.faces[np.maximum(hits.face, 0)]])
        out[~hits.hit] = np.nan
        return out

    def seen_from(self, camera: Camera, points: NDArray[Any], normals: NDArray[Any], least_cosine: float, lift: float) -> NDArray[np.bool_]:
        """Which points (n, 3) of the mesh with outward unit `normals` (n, 3) are in the camera's picture, hidden by nothing, and look at it
        under more than `least_cosine`; rays start `lift` (mesh units) above them."""
        pixel, z = camera.project(points)
        way = camera.centre - points
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        seen = camera.shows(pixel, z) & (np.einsum("nk,nk->n", way, normals) > least_cosine)
        rows = np.flatnonzero(seen)
        seen[rows] = ~self.occluded(points[rows] + lift * normals[rows], way[rows])
        return seen

    def depth(self, camera: Camera) -> NDArray[np.float32]:
        """Depth z (h, w) of the mesh through the pixel centres of `camera`; 0 where nothing is seen."""
        rays = camera.rays().reshape(-1, 3)  # depth z = 1 along each, so distances are depths
        hits = self.first_hit(camera.centre[None], rays)
        return np.where(hits.hit, hits.distance, np.float32(0)).reshape(camera.height, camera.width)

    def _rays(self, origins: ArrayLike, directions: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
        """Origins and directions with one row each per ray, as views."""
        rays_o, rays_d = np.asarray(origins).reshape(-1, 3), np.asarray(directions).reshape(-1, 3)
        n = max(len(rays_o), len(rays_d)) if min(len(rays_o), len(rays_d)) else 0
        return np.broadcast_to(rays_o, (n, 3)), np.broadcast_to(rays_d, (n, 3))

    def _inner(self, origins: NDArray[Any]) -> NDArray[np.float32]:
        return np.ascontiguousarray((origins - self._centre) * self._scale, np.float32)

    def _direction(self, directions: NDArray[Any]) -> NDArray[np.float32]:
        # Scaled like the origins, so that the ray parameter keeps the caller's meaning.
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
