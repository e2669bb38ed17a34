"""Cube maps: texel directions, solid angles and seamless bilinear taps.

Faces are stored in the order +X, −X, +Y, −Y, +Z, −Z with the orientation of the OpenGL specification (table "selection of cube map
images"): row 0 is t = −1 and column 0 is s = −1, texel (i, j) has its centre at s = (2j+1)/N − 1, t = (2i+1)/N − 1, and
(s, t) stand for

    face   +X        −X        +Y        −Y        +Z        −Z
    s·m    −z        +z        +x        +x        +x        −x
    t·m    −y        −y        +z        −z        −y        −y        m = the absolute value of the major axis

Between texel centres values are bilinear, also across edges: every face is padded by the row of its neighbour, and at the eight
corners, where only three texels meet, by the mean of those three; so the interpolant is continuous everywhere.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from gsbake.geometry.vectors import unit

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Per face the directions of growing s, growing t, and the face's axis.
FACE_S = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
FACE_T = np.array([[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, -1, 0]], dtype=np.float64)
FACE_AXIS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)


def directions(size: int) -> Array:
    """Unit directions of the texel centres, (6, size, size, 3)."""
    x = (2.0 * np.arange(size) + 1.0) / size - 1.0
    t, s = np.meshgrid(x, x, indexing="ij")
    return unit(FACE_AXIS[:, None, None] + s[None, :, :, None] * FACE_S[:, None, None] + t[None, :, :, None] * FACE_T[:, None, None])


def solid_angles(size: int) -> Array:
    """Solid angles of the texels in steradians, (6, size, size); they sum to 4π.

    The angle subtended by the rectangle from the face centre to (s, t) is atan(st / √(s² + t² + 1)).
    """
    edge = np.linspace(-1.0, 1.0, size + 1)
    t, s = np.meshgrid(edge, edge, indexing="ij")
    corner = np.arctan2(s * t, np.sqrt(s * s + t * t + 1.0))
    face = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return np.broadcast_to(face, (6, size, size)).copy()


def locate(dirs: Array) -> tuple[Index, Array, Array]:
    """Face (n,) and face coordinates s, t (n,) in [−1, 1] of directions (n, 3) of any length above zero."""
    axis = np.abs(dirs).argmax(axis=1)
    major = dirs[np.arange(len(dirs)), axis]
    face = 2 * axis + (major < 0)
    scale = 1.0 / np.abs(major)
    s = np.einsum("nk,nk->n", dirs, FACE_S[face]) * scale
    t = np.einsum("nk,nk->n", dirs, FACE_T[face]) * scale
    return face, s, t


def texel(size: int, dirs: Array) -> Index:
    """Flat index (n,) into (6·size²) of the texel that holds each direction (n, 3)."""
    face, s, t = locate(dirs)
    col = np.clip(((s + 1.0) * 0.5 * size).astype(np.int64), 0, size - 1)
    row = np.clip(((t + 1.0) * 0.5 * size).astype(np.int64), 0, size - 1)
    return (face * size + row) * size + col


@lru_cache(maxsize=32)
def padding(size: int) -> scipy.sparse.csr_matrix:
    """The constant matrix (6·(size+2)², 6·size²) that pads flattened faces by one texel of their neighbours."""
    inner = (2.0 * np.arange(size) + 1.0) / size - 1.0
    # Just beyond the edge: far enough to land on the neighbour, near enough to keep the index along the edge.
    beyond = 1.0 + 0.01 / size
    coord = np.concatenate([[-beyond], inner, [beyond]])
    t, s = np.meshgrid(coord, coord, indexing="ij")
    dirs = FACE_AXIS[:, None, None] + s[None, :, :, None] * FACE_S[:, None, None] + t[None, :, :, None] * FACE_T[:, None, None]
    source = texel(size, dirs.reshape(-1, 3)).reshape(6, size + 2, size + 2)
    edge = np.zeros((size + 2, size + 2), dtype=np.int64)
    edge[[0, -1], :] += 1
    edge[:, [0, -1]] += 1
    row = np.arange(source.size).reshape(source.shape)
    plain = np.broadcast_to(edge < 2, source.shape)
    rows, cols, values = [row[plain]], [source[plain]], [np.ones(int(plain.sum()))]
    for i, i_in in ((0, 1), (size + 1, size)):
        for j, j_in in ((0, 1), (size + 1, size)):
            # Three texels meet at a corner: this face's own, and the neighbours across either edge.
            for a, b in ((i_in, j_in), (i, j_in), (i_in, j)):
                rows.append(row[:, i, j])
                cols.append(source[:, a, b])
                values.append(np.full(6, 1.0 / 3.0))
    shape = (source.size, 6 * size * size)
    return scipy.sparse.coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=shape).tocsr()


def padded_taps(size: int, dirs: Array) -> tuple[Index, Array]:
    """Bilinear taps of directions (n, 3): indices (n, 4) into the padded faces and weights (n, 4) that sum to 1."""
    face, s, t = locate(dirs)
    x = (s + 1.0) * 0.5 * size + 0.5
    y = (t + 1.0) * 0.5 * size + 0.5
    col = np.clip(np.floor(x).astype(np.int64), 0, size)
    row = np.clip(np.floor(y).astype(np.int64), 0, size)
    fx, fy = x - col, y - row
    wide = size + 2
    base = (face * wide + row) * wide + col
    index = np.stack([base, base + 1, base + wide, base + wide + 1], axis=1)
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    return index, weight


def interpolation(size: int, dirs: Array) -> scipy.sparse.csr_matrix:
    """The constant matrix (n, 6·size²) that evaluates the seamless bilinear interpolant at directions (n, 3)."""
    index, weight = padded_taps(size, dirs)
    indptr = np.arange(0, 4 * len(dirs) + 1, 4)
    taps = scipy.sparse.csr_matrix((weight.ravel(), index.ravel(), indptr), shape=(len(dirs), 6 * (size + 2) ** 2))
    return (taps @ padding(size)).tocsr()


def sample(cube: NDArray[np.floating], dirs: Array) -> Array:
    """Values (n, c) of a cube map (6, N, N, c) at directions (n, 3), seamless bilinear."""
    if cube.ndim != 4 or cube.shape[0] != 6 or cube.shape[1] != cube.shape[2]:
        raise ValueError(f"a cube map has shape (6, N, N, c), not {cube.shape}")
    size = cube.shape[1]
    index, weight = padded_taps(size, np.asarray(dirs, dtype=np.float64))
    padded = padding(size) @ cube.reshape(-1, cube.shape[3]).astype(np.float64)
    return np.einsum("nk,nkc->nc", weight, padded[index])


@lru_cache(maxsize=32)
def reduction(size: int, coarse: int) -> scipy.sparse.csr_matrix:
    """The constant matrix (6·coarse², 6·size²) that averages a cube map down to `coarse` texels per edge.

    The adjoint of interpolating from the coarse map, weighted by solid angle: fine texels hand their flux to the coarse texels around them
    in proportion to the bilinear weights. Constants stay constant, and total flux and its first moment are kept for any ratio of the sizes.
    """
    spread = interpolation(coarse, directions(size).reshape(-1, 3)).multiply(solid_angles(size).reshape(-1, 1)).T.tocsr()
    total = np.asarray(spread.sum(axis=1)).ravel()
    return (scipy.sparse.diags(1.0 / total) @ spread).tocsr()
