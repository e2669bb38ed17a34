"""Operators on a triangle mesh that the refinement needs: normals, averages over neighbours, gradients on faces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

Doubles = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True)
class Surface:
    """Connectivity of a mesh with `count` vertices and `faces` (f, 3), outward; vertices without a face are allowed."""

    count: int
    faces: Faces

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """Each edge once (e, 2), the smaller vertex first."""
        pairs = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
        keys = np.unique(pairs[:, 0] * self.count + pairs[:, 1])
        return np.stack([keys // self.count, keys % self.count], 1)

    @cached_property
    def adjacency(self) -> sparse.csr_matrix:
        """Neighbours (count, count), 1 for each."""
        a, b = self.edges.T
        ones = np.ones(2 * len(a))
        return sparse.csr_matrix((ones, (np.concatenate([a, b]), np.concatenate([b, a]))), (self.count, self.count))

    @cached_property
    def degree(self) -> Doubles:
        """Number of neighbours (count,), at least 1."""
        return np.maximum(np.asarray(self.adjacency.sum(1), np.float64).ravel(), 1.0)

    @cached_property
    def umbrella(self) -> sparse.csr_matrix:
        """Vertex minus the mean of its neighbours (count, count); 0 for a vertex without any (Kobbelt et al., SIGGRAPH 1998)."""
        some = np.asarray(self.adjacency.sum(1)).ravel() > 0
        return (sparse.diags(some.astype(float)) - sparse.diags(1 / self.degree) @ self.adjacency).tocsr()

    @cached_property
    def squared_umbrella(self) -> sparse.csr_matrix:
        """UᵀU of the umbrella operator."""
        return (self.umbrella.T @ self.umbrella).tocsr()

    @cached_property
    def _corner_sum(self) -> sparse.csr_matrix:
        """Sums (count, 3f) of values at the faces' corners."""
        corners = self.faces.ravel()
        return sparse.csr_matrix((np.ones(len(corners)), (corners, np.arange(len(corners)))), (self.count, len(corners)))

    @cached_property
    def _stiffness_pattern(self) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32], int]:
        """Where the nine entries of each face go in a CSR matrix: their slots, its indices and row starts."""
        rows, columns = np.repeat(self.faces, 3, 1).ravel().astype(np.int64), np.tile(self.faces, (1, 3)).ravel().astype(np.int64)
        keys, slots = np.unique(rows * self.count + columns, return_inverse=True)
        starts = np.searchsorted(keys // max(self.count, 1), np.arange(self.count + 1))
        return slots.ravel(), (keys % max(self.count, 1)).astype(np.int32), starts.astype(np.int32), len(keys)

    def stiffness(self, blocks: Doubles) -> sparse.csr_matrix:
        """The matrix (count, count) that sums the faces' `blocks` (f, 3, 3)."""
        slots, indices, starts, size = self._stiffness_pattern
        data = np.bincount(slots, blocks.ravel(), minlength=size)
        return sparse.csr_matrix((data, indices, starts), (self.count, self.count))

    def sum_corners(self, values: Doubles) -> Doubles:
        """Sums (count, …) over the faces of `values` (f, 3, …) at their corners."""
        flat = values.reshape(len(values) * 3, int(np.prod(values.shape[2:])))  # -1 is ambiguous without faces
        return np.asarray(self._corner_sum @ flat, np.float64).reshape(self.count, *values.shape[2:])

    def normals(self, vertices: Doubles) -> Doubles:
        """Area-weighted unit normals (count, 3); 0 without a face."""
        a, b, c = (vertices[self.faces[:, k]] for k in range(3))
        total = self.sum_corners(np.repeat(np.cross(b - a, c - a)[:, None], 3, 1))
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0))

    def gradients(self, vertices: Doubles) -> Doubles:
        """Gradients (f, 3, 3) of the hat functions of the faces' corners; 0 for faces without area."""
        a, b, c = (vertices[self.faces[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        square = np.square(cross).sum(1)
        inverse = np.divide(1.0, square, out=np.zeros_like(square), where=square > 0)
        opposite = np.stack([c - b, a - c, b - a], 1)
        return np.cross(cross[:, None], opposite) * inverse[:, None, None]

    def mean_edge(self, vertices: Doubles) -> float:
        """Mean length of the edges."""
        a, b = self.edges.T
        return float(np.linalg.norm(vertices[a] - vertices[b], axis=1).mean()) if len(a) else 0.0

    def averaged(self, values: NDArray[Any], steps: int) -> NDArray[np.float32]:
        """`values` (count, …) after `steps` half-steps towards the mean of their neighbours."""
        matrix = self.adjacency
        current = np.ascontiguousarray(values.reshape(self.count, -1), np.float32)
        other = np.empty_like(current)
        for _ in range(steps):
            run_chunks(partial(_average_rows, matrix.indptr, matrix.indices, current, other), self.count)
            current, other = other, current
        return current.reshape(values.shape)


@kernel("i8, i8, i4[::1], i4[::1], f4[:, ::1], f4[:, ::1]", error_model="numpy", nogil=True)
def average(start: int, stop: int, starts: Any, neighbours: Any, values: Any, out: Any) -> None:
    """Half the value of each row start..stop of `values` (v, k) plus half the mean of its neighbours'; a row without any stays."""
    columns = values.shape[1]
    half = np.float32(0.5)
    for v in range(start, stop):
        first, last = starts[v], starts[v + 1]
        if first == last:
            for c in range(columns):
                out[v, c] = values[v, c]
            continue
        for c in range(columns):
            out[v, c] = np.float32(0)
        for k in range(first, last):
            u = neighbours[k]
            for c in range(columns):
                out[v, c] += values[u, c]
        factor = half / np.float32(last - first)
        for c in range(columns):
            out[v, c] = half * values[v, c] + factor * out[v, c]


def _average_rows(starts: Any, neighbours: Any, values: Any, out: Any, start: int, stop: int) -> None:
    average(start, stop, starts, neighbours, values, out)


def surface_area(vertices: Doubles, faces: Faces) -> float:
    """Area of a mesh of `vertices` (v, 3) and `faces` (f, 3)."""
    corners = vertices[faces]
    return 0.5 * float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())


def tangents(normals: Doubles) -> Doubles:
    """Two unit tangents (v, 2, 3) of each normal."""
    axis = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-20)
    return np.stack([first, np.cross(normals, first)], 1)
