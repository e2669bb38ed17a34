"""Marching cubes on a sparse lattice, in super-blocks that are welded exactly.

scikit-image's marching cubes (Lewiner et al., *Efficient implementation of marching cubes' cases with topological guarantees*, 2003)
runs on dense super-blocks that share one layer of samples. A vertex lies on one edge of the lattice or inside one cube, which gives it an
integer key; vertices of neighbouring super-blocks with equal keys are merged. No seam stays open, and no distance threshold merges
vertices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from gsbake.geometry.sparse_lattice import EDGE, BlockLattice, Floats, gather_samples
from gsbake.kernels.declaration import kernel

#: Samples along a super-block's edge, without the layer shared with the next one: 1 MB of field.
SUPER_BLOCK = 8 * EDGE
#: Minimum magnitude of field values: no vertex falls on a lattice point, so each lies on one edge only.
MIN_MAGNITUDE = 2e-3


@kernel("f4[:, :, ::1], i8[::1], f8, f8, f4[:, :, ::1]")
def upsample_coarse(coarse: Any, start: Any, ratio: float, scale: float, out: Any) -> None:
    """Fill the dense `out`, whose first sample is fine sample `start`, with the trilinear `coarse` lattice times `scale`, clamped to ±1.

    `ratio` is fine cells per coarse cell; both lattices have the same lower corner.
    """
    for i in range(out.shape[0]):
        x = min(max((start[0] + i) / ratio, 0.0), coarse.shape[0] - 1.001)
        x0 = int(x)
        a = x - x0
        for j in range(out.shape[1]):
            y = min(max((start[1] + j) / ratio, 0.0), coarse.shape[1] - 1.001)
            y0 = int(y)
            b = y - y0
            for k in range(out.shape[2]):
                z = min(max((start[2] + k) / ratio, 0.0), coarse.shape[2] - 1.001)
                z0 = int(z)
                c = z - z0
                low = (coarse[x0, y0, z0] * (1 - a) + coarse[x0 + 1, y0, z0] * a) * (1 - b)
                low += (coarse[x0, y0 + 1, z0] * (1 - a) + coarse[x0 + 1, y0 + 1, z0] * a) * b
                high = (coarse[x0, y0, z0 + 1] * (1 - a) + coarse[x0 + 1, y0, z0 + 1] * a) * (1 - b)
                high += (coarse[x0, y0 + 1, z0 + 1] * (1 - a) + coarse[x0 + 1, y0 + 1, z0 + 1] * a) * b
                value = (low * (1 - c) + high * c) * scale
                out[i, j, k] = min(max(value, -1.0), 1.0)


def extract_isosurface(
    lattice: BlockLattice, values: Floats, coarse: Floats | None = None, ratio: float = 1.0, scale: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Zero set of `values` (n, 8, 8, 8; negative inside; NaN = unknown) as `vertices` (v, 3) and `faces` (f, 3), outward winding.

    Without `coarse`, cubes with an unknown corner are skipped and the surface is open there. With `coarse` (a dense field on the same box,
    `ratio` fine cells per sample, multiplied by `scale`), samples outside the blocks take its values and the surface is closed.
    """
    sizes = np.array(lattice.samples, np.int64)
    vertices: list[NDArray[np.float64]] = []
    keys: list[NDArray[np.int64]] = []
    triangles: list[NDArray[np.int64]] = []
    count = 0
    for start in _super_blocks(lattice, coarse, ratio):
        size = np.minimum(SUPER_BLOCK + 1, sizes - start)
        if (size < 2).any():
            continue
        field = np.full(size, np.nan, np.float32)
        if coarse is not None:
            upsample_coarse(coarse, start, ratio, scale, field)
        gather_samples(lattice.index, values, start, field)
        part = _march_super_block(field, start, sizes)
        if part is None:
            continue
        local, key, triangle = part
        vertices.append(local + start)
        keys.append(key)
        triangles.append(triangle.astype(np.int64) + count)
        count += len(local)
    if not vertices:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    _, first, inverse = np.unique(np.concatenate(keys), return_index=True, return_inverse=True)
    faces = inverse[np.concatenate(triangles)]
    return lattice.lower + lattice.cell * np.concatenate(vertices)[first], faces.astype(np.int32)


def _super_blocks(lattice: BlockLattice, coarse: Floats | None, ratio: float) -> list[NDArray[np.int64]]:
    """First samples of the super-blocks that may contain surface, in a fixed order."""
    side = SUPER_BLOCK // EDGE
    out = []
    for a in range(0, lattice.shape[0], side):
        for b in range(0, lattice.shape[1], side):
            for c in range(0, lattice.shape[2], side):
                # One more block: the shared layer belongs to the next super-block.
                occupied = bool((lattice.index[a : a + side + 1, b : b + side + 1, c : c + side + 1] >= 0).any())
                start = np.array([a, b, c], np.int64) * EDGE
                if not occupied and coarse is not None:
                    lo = np.floor(start / ratio).astype(int)
                    hi = np.ceil((start + SUPER_BLOCK + 1) / ratio).astype(int) + 2
                    part = coarse[lo[0] : hi[0], lo[1] : hi[1], lo[2] : hi[2]]
                    occupied = bool(part.size > 0 and part.min() < 0 < part.max())
                if occupied:
                    out.append(start)
    return out


def _march_super_block(field: Floats, start: NDArray[np.int64], sizes: NDArray[np.int64]) -> tuple[Any, NDArray[np.int64], Any] | None:
    """Vertices (in local samples), their keys and the triangles of one dense super-block; None when it contains no surface."""
    valid = np.isfinite(field)
    field = np.where(field < 0, np.minimum(field, -MIN_MAGNITUDE), np.maximum(field, MIN_MAGNITUDE))
    mask = None
    if valid.all():
        if field.min() > 0 or field.max() < 0:
            return None
    else:
        field[~valid] = 1.0
        corners = [valid[a : a - 1 or None, b : b - 1 or None, c : c - 1 or None] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
        mask = np.zeros(field.shape, np.bool_)
        mask[1:, 1:, 1:] = np.logical_and.reduce(corners)  # scikit-image reads the mask at a cube's upper corner
        inside = field < 0
        if not (inside & valid).any() or not mask.any():
            return None
    try:
        local, triangle, _, _ = marching_cubes(field, 0.0, gradient_direction="descent", allow_degenerate=True, mask=mask)
    except RuntimeError:  # "No surface found": the sign changes only across unknown cubes
        return None
    local = local.astype(np.float64)
    base = np.floor(local)
    inner = local - base
    fractional = inner > 0
    base = base.astype(np.int64) + start
    # 1, 2, 4: on an edge along that axis; more than one bit: a vertex inside a cube.
    edge_code = fractional[:, 0] + 2 * fractional[:, 1] + 4 * fractional[:, 2]
    key = ((base[:, 0] * sizes[1] + base[:, 1]) * sizes[2] + base[:, 2]) * 8 + edge_code
    return local, key, triangle
