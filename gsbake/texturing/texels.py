"""Rasterisation of the UV atlas: the surface point of each texel.

Every texel whose centre lies in a triangle of the UV atlas gets that triangle and exact barycentrics; texels within one texel of a chart's
border, which bilinear filtering reads, get the nearest point of the chart. Texel (i, j) has its centre at (i + .5, j + .5); row 0 is the
top of the image (v = 0 in glTF).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: How far outside a chart (in texels) a texel still takes the chart's nearest point.
BORDER = 1.0
#: Triangles overlapping by no more than a sliver of this width (in texels) do not count as overlapping.
MARGIN = 0.05


@dataclass(frozen=True)
class Texels:
    """The n texels of a square texture of `size` that lie on the surface.

    `index` (n,) int64 flat row-major texel; `face` (n,) int32; `bary` (n, 3) float32; `inside` (n,) False where the texel lies just outside
    its chart.
    """

    size: int
    index: NDArray[np.int64]
    face: NDArray[np.int32]
    bary: Floats
    inside: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.index)

    def interpolate(self, values: NDArray[Any], faces: NDArray[Any]) -> Floats:
        """Vertex `values` (v, c) over `faces` (f, 3), interpolated at each texel: (n, c) float32."""
        v, f = np.ascontiguousarray(values, np.float32), np.ascontiguousarray(faces, np.int32)
        out = np.zeros((len(self), v.shape[1]), np.float32)
        run_chunks(lambda lo, hi: _interpolate(lo, hi, v, f, self.face, self.bary, out), len(self))
        return out

    @cached_property
    def lookup(self) -> NDArray[np.int64]:
        """Index (size²,) of the texel at each flat position of the texture, -1: none."""
        out = np.full(self.size * self.size, -1, np.int64)
        out[self.index] = np.arange(len(self))
        return out

    def containing(self, uv: NDArray[Any]) -> NDArray[np.int64]:
        """Index (m,) of the texel that contains each texture coordinate (m, 2) (origin top left), -1: none."""
        x, y = np.clip((uv * self.size).astype(np.int64), 0, self.size - 1).T
        return np.asarray(self.lookup[y * self.size + x])

    def image(self, values: NDArray[Any], empty: float = 0.0) -> Floats:
        """An image (size, size, c) float32 with texel `values` (n, c) or (n,) in place and `empty` elsewhere."""
        columns = np.asarray(values, np.float32).reshape(len(self), -1)
        out = np.full((self.size * self.size, columns.shape[1]), empty, np.float32)
        out[self.index] = columns
        return out.reshape(self.size, self.size, -1)

    def covered(self) -> NDArray[np.bool_]:
        """Mask (size, size) of the texels on the surface."""
        out = np.zeros(self.size * self.size, bool)
        out[self.index] = True
        return out.reshape(self.size, self.size)


def rasterise(uv: NDArray[Any], faces: NDArray[Any], size: int, rows: tuple[int, int] | None = None) -> Texels:
    """Texels of a mesh with `uv` (v, 2) (origin top left, 0..1) and `faces` (f, 3) on a square texture of `size`.

    `rows`, the first and the one after the last, are those that are looked at; all by default.
    """
    first, end = rows or (0, size)
    owner = np.full((end - first, size), -1, np.int32)
    bary = np.zeros((*owner.shape, 3), np.float32)
    distance = np.full(owner.shape, np.float32(np.inf))
    _draw(np.asarray(uv, np.float64) * size - [0, first], np.ascontiguousarray(faces, np.int32), owner, bary, distance)
    index = np.flatnonzero(owner.ravel() >= 0)
    return Texels(size, index + first * size, owner.ravel()[index], bary.reshape(-1, 3)[index], distance.ravel()[index] == 0)


def overlapping(uv: NDArray[Any], faces: NDArray[Any], size: int) -> int:
    """How many texel centres of a texture of `size` lie in more than one of the triangles `faces` (f, 3) of `uv` (v, 2)."""
    return _overlaps(uv, faces, size)[0]


def overlapping_faces(uv: NDArray[Any], faces: NDArray[Any], size: int) -> NDArray[np.bool_]:
    """Which triangles (f,) cover a texel centre that an earlier one covers; without them there is no overlap."""
    return _overlaps(uv, faces, size)[1]


def _overlaps(uv: NDArray[Any], faces: NDArray[Any], size: int) -> tuple[int, NDArray[np.bool_]]:
    owner, later = np.full((size, size), -1, np.int32), np.zeros(len(faces), np.bool_)
    count = int(_overlapping(np.asarray(uv, np.float64) * size, np.ascontiguousarray(faces, np.int32), owner, later))
    return count, later


@kernel("f8[:, ::1], i4[:, ::1], i4[:, ::1], f4[:, :, ::1], f4[:, ::1]", error_model="numpy")
def _draw(uv: Doubles, faces: NDArray[np.int32], owner: NDArray[np.int32], bary: Floats, distance: Floats) -> None:
    """Fill `owner`, `bary` and `distance` (texels to the triangle, 0 inside) with the nearest triangle within `BORDER`."""
    height, width = owner.shape
    corner = np.zeros((3, 2))
    weight = np.zeros(3)
    for f in range(faces.shape[0]):
        for k in range(3):
            corner[k, 0], corner[k, 1] = uv[faces[f, k], 0], uv[faces[f, k], 1]
        area = (corner[1, 0] - corner[0, 0]) * (corner[2, 1] - corner[0, 1]) - (corner[2, 0] - corner[0, 0]) * (corner[1, 1] - corner[0, 1])
        if not abs(area) > 1e-12:
            continue
        low_i = max(0, int(np.ceil(corner[:, 0].min() - BORDER - 0.5)))
        high_i = min(width - 1, int(np.floor(corner[:, 0].max() + BORDER - 0.5)))
        low_j = max(0, int(np.ceil(corner[:, 1].min() - BORDER - 0.5)))
        high_j = min(height - 1, int(np.floor(corner[:, 1].max() + BORDER - 0.5)))
        for j in range(low_j, high_j + 1):
            for i in range(low_i, high_i + 1):
                if distance[j, i] == 0:
                    continue
                x, y = i + 0.5, j + 0.5
                inside = True
                for k in range(3):
                    a, b = (k + 1) % 3, (k + 2) % 3
                    weight[k] = ((corner[a, 0] - x) * (corner[b, 1] - y) - (corner[b, 0] - x) * (corner[a, 1] - y)) / area
                    inside = inside and weight[k] >= 0
                far = 0.0
                if not inside:
                    far = _nearest_on_outline(corner, x, y, weight)
                    if not far <= BORDER:
                        continue
                if far < distance[j, i]:
                    distance[j, i] = far
                    owner[j, i] = f
                    for k in range(3):
                        bary[j, i, k] = weight[k]


@kernel("f8[:, ::1], i4[:, ::1], i4[:, ::1], b1[::1]", error_model="numpy")
def _overlapping(uv: Doubles, faces: NDArray[np.int32], owner: NDArray[np.int32], later: NDArray[np.bool_]) -> int:
    """Texel centres deeper than `MARGIN` in more than one triangle; `owner` (s, s) of -1 is scratch, `later` (f,) marks the later ones."""
    size = owner.shape[0]
    count = 0
    for f in range(faces.shape[0]):
        x0, y0 = uv[faces[f, 0], 0], uv[faces[f, 0], 1]
        x1, y1 = uv[faces[f, 1], 0], uv[faces[f, 1], 1]
        x2, y2 = uv[faces[f, 2], 0], uv[faces[f, 2], 1]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if not abs(area) > 1e-12:
            continue
        sign = 1.0 if area > 0 else -1.0
        for j in range(max(0, int(np.ceil(min(y0, y1, y2) - 0.5))), min(size - 1, int(np.floor(max(y0, y1, y2) - 0.5))) + 1):
            for i in range(max(0, int(np.ceil(min(x0, x1, x2) - 0.5))), min(size - 1, int(np.floor(max(x0, x1, x2) - 0.5))) + 1):
                x, y = i + 0.5, j + 0.5
                deep = np.inf
                for e in range(3):
                    ax, ay = (x0, y0) if e == 0 else ((x1, y1) if e == 1 else (x2, y2))
                    bx, by = (x1, y1) if e == 0 else ((x2, y2) if e == 1 else (x0, y0))
                    length = np.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
                    deep = min(deep, sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / max(length, 1e-12))
                if deep > MARGIN:
                    if owner[j, i] >= 0:
                        count += 1
                        later[f] = True
                    owner[j, i] = f
    return count


@numba.njit(cache=True, error_model="numpy")
def _nearest_on_outline(corner: Doubles, x: float, y: float, weight: Doubles) -> float:
    """Distance from (x, y) to the outline of a triangle (3, 2); `weight` (3,) receives the barycentrics of the nearest point."""
    best = np.inf
    w0, w1, w2 = 0.0, 0.0, 0.0
    for k in range(3):
        a, b = k, (k + 1) % 3
        ex, ey = corner[b, 0] - corner[a, 0], corner[b, 1] - corner[a, 1]
        length2 = ex * ex + ey * ey
        s = ((x - corner[a, 0]) * ex + (y - corner[a, 1]) * ey) / length2 if length2 > 0 else 0.0
        s = min(max(s, 0.0), 1.0)
        dx, dy = corner[a, 0] + s * ex - x, corner[a, 1] + s * ey - y
        far = dx * dx + dy * dy
        if far < best:
            best = far
            w0 = 1 - s if a == 0 else (s if b == 0 else 0.0)
            w1 = 1 - s if a == 1 else (s if b == 1 else 0.0)
            w2 = 1 - s if a == 2 else (s if b == 2 else 0.0)
    weight[0], weight[1], weight[2] = w0, w1, w2
    return np.sqrt(best)


@kernel("i8, i8, f4[:, ::1], i4[:, ::1], i4[::1], f4[:, ::1], f4[:, ::1]", nogil=True, error_model="numpy")
def _interpolate(lo: int, hi: int, values: Floats, faces: NDArray[np.int32], face: NDArray[np.int32], bary: Floats, out: Floats) -> None:
    """Write `values` (v, c) at the texels lo..hi, given by `face` (n,) and `bary` (n, 3), to `out` (n, c)."""
    for n in range(lo, hi):
        for c in range(values.shape[1]):
            total = np.float32(0)
            for k in range(3):
                total += bary[n, k] * values[faces[face[n], k], c]
            out[n, c] = total
