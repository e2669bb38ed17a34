"""Cube maps: texel directions, solid angles and seamless bilinear interpolation.

Faces are stored in the order +X, −X, +Y, −Y, +Z, −Z with the orientation of the OpenGL specification (table "selection of cube map
images"): row 0 is at t = −1 and column 0 at s = −1, the centre of texel (i, j) is at s = (2j+1)/N − 1, t = (2i+1)/N − 1, with

    face   +X        −X        +Y        −Y        +Z        −Z
    s·m    −z        +z        +x        +x        +x        −x
    t·m    −y        −y        +z        −z        −y        −y        m = the absolute value of the major axis

Interpolation is bilinear, also across edges: every face is padded by one row of texels of its neighbours, and at the eight corners, where
three texels meet, by their mean. So the interpolant is continuous everywhere.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from gsbake.geometry.vectors import unit

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Per face the directions of increasing s and t, and the face's axis.
FACE_S = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
FACE_T = np.array([[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, -1, 0]], dtype=np.float64)
FACE_AXIS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)


def directions(size: int) -> Array:
    """Unit directions of the texel centres, (6, size, size, 3)."""
    x = (2.0 * np.arange(size) + 1.0) / size - 1.0
    t, s = np.meshgrid(x, x, indexing="ij")
    return unit(FACE_AXIS[:, None, None] + s[None, :, :, None] * FACE_S[:, None, None] + t[None, :, :, None] * FACE_T[:, None, None])


def solid_angles(size: int) -> Array:
    """Solid angles of the texels in steradians, (6, size, size); their sum is 4π.

    The solid angle of the rectangle from the face centre to (s, t) is atan(st / √(s² + t² + 1)).
    """
    edge = np.linspace(-1.0, 1.0, size + 1)
    t, s = np.meshgrid(edge, edge, indexing="ij")
    corner = np.arctan2(s * t, np.sqrt(s * s + t * t + 1.0))
    face = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return np.broadcast_to(face, (6, size, size)).copy()


def locate(dirs: Array) -> tuple[Index, Array, Array]:
    """Face (n,) and face coordinates s, t (n,) in [−1, 1] of non-zero directions (n, 3)."""
    axis = np.abs(dirs).argmax(axis=1)
    major = dirs[np.arange(len(dirs)), axis]
    face = 2 * axis + (major < 0)
    scale = 1.0 / np.abs(major)
    s = np.einsum("nk,nk->n", dirs, FACE_S[face]) * scale
    t = np.einsum("nk,nk->n", dirs, FACE_T[face]) * scale
    return face, s, t


def texel_index(size: int, dirs: Array) -> Index:
    """Flat index (n,) into (6·size²) of the texel that contains each direction (n, 3)."""
    face, s, t = locate(dirs)
    col = np.clip(((s + 1.0) * 0.5 * size).astype(np.int64), 0, size - 1)
    row = np.clip(((t + 1.0) * 0.5 * size).astype(np.int64), 0, size - 1)
    return (face * size + row) * size + col


@lru_cache(maxsize=32)
def padding_matrix(size: int) -> scipy.sparse.csr_matrix:
    """Sparse matrix (6·(size+2)², 6·size²) that pads flattened faces by one texel of their neighbours."""
    inner = (2.0 * np.arange(size) + 1.0) / size - 1.0
    # Just beyond the edge: on the neighbouring face, with the same index along the edge.
    beyond = 1.0 + 0.01 / size
    coord = np.concatenate([[-beyond], inner, [beyond]])
    t, s = np.meshgrid(coord, coord, indexing="ij")
    dirs = FACE_AXIS[:, None, None] + s[None, :, :, None] * FACE_S[:, None, None] + t[None, :, :, None] * FACE_T[:, None, None]
    source = texel_index(size, dirs.reshape(-1, 3)).reshape(6, size + 2, size + 2)
    edge = np.zeros((size + 2, size + 2), dtype=np.int64)
    edge[[0, -1], :] += 1
    edge[:, [0, -1]] += 1
    row = np.arange(source.size).reshape(source.shape)
    no_corner = np.broadcast_to(edge < 2, source.shape)
    rows, cols, values = [row[no_corner]], [source[no_corner]], [np.ones(int(no_corner.sum()))]
    for i, i_in in ((0, 1), (size + 1, size)):
        for j, j_in in ((0, 1), (size + 1, size)):
            # Three texels meet at a corner: that of this face, and the neighbours across both edges.
            for a, b in ((i_in, j_in), (i, j_in), (i_in, j)):
                rows.append(row[:, i, j])
                cols.append(source[:, a, b])
                values.append(np.full(6, 1.0 / 3.0))
    shape = (source.size, 6 * size * size)
    return scipy.sparse.coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=shape).tocsr()


def bilinear_taps(size: int, dirs: Array) -> tuple[Index, Array]:
    """Bilinear interpolation at directions (n, 3): indices (n, 4) into the padded faces and weights (n, 4) with sum 1."""
    face, s, t = locate(dirs)
    x = (s + 1.0) * 0.5 * size + 0.5
    y = (t + 1.0) * 0.5 * size + 0.5
    col = np.clip(np.floor(x).astype(np.int64), 0, size)
    row = np.clip(np.floor(y).astype(np.int64), 0, size)
    fx, fy = x - col, y - row
    stride = size + 2
    base = (face * stride + row) * stride + col
    index = np.stack([base, base + 1, base + stride, base + stride + 1], axis=1)
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    return index, weight


def interpolation_matrix(size: int, dirs: Array) -> scipy.sparse.csr_matrix:
    """Sparse matrix (n, 6·size²) that evaluates the seamless bilinear interpolant at directions (n, 3)."""
    index, weight = bilinear_taps(size, dirs)
    indptr = np.arange(0, 4 * len(dirs) + 1, 4)
    taps = scipy.sparse.csr_matrix((weight.ravel(), index.ravel(), indptr), shape=(len(dirs), 6 * (size + 2) ** 2))
    return (taps @ padding_matrix(size)).tocsr()


def sample(cube: NDArray[np.floating], dirs: Array) -> Array:
    """Values (n, c) of a cube map (6, N, N, c) at directions (n, 3), by seamless bilinear interpolation."""
    if cube.ndim != 4 or cube.shape[0] != 6 or cube.shape[1] != cube.shape[2]:
        raise ValueError(f"a cube map has shape (6, N, N, c), not {cube.shape}")
    size = cube.shape[1]
    index, weight = bilinear_taps(size, np.asarray(dirs, dtype=np.float64))
    padded = padding_matrix(size) @ cube.reshape(-1, cube.shape[3]).astype(np.float64)
    return np.einsum("nk,nkc->nc", weight, padded[index])


@lru_cache(maxsize=32)
def downsampling_matrix(size: int, coarse: int) -> scipy.sparse.csr_matrix:
    """Sparse matrix (6·coarse², 6·size²) that downsamples a cube map to `coarse` texels per edge.

    The adjoint of interpolation in the coarse map, weighted by solid angle: the flux of fine texels is distributed to the coarse texels
    around them by the bilinear weights. Constants, total flux and its first moment are preserved for any ratio of the sizes.
    """
    adjoint = interpolation_matrix(coarse, directions(size).reshape(-1, 3)).multiply(solid_angles(size).reshape(-1, 1)).T.tocsr()
    total = np.asarray(adjoint.sum(axis=1)).ravel()
    return (scipy.sparse.diags(1.0 / total) @ adjoint).tocsr()
