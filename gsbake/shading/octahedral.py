"""Octahedral mapping of the sphere to one square.

Cigolle et al., *A Survey of Efficient Representations for Independent Unit Vectors*, JCGT 3(2), 2014. A direction d is projected on the
octahedron |x|+|y|+|z| = 1; the upper half is viewed from +Z, the lower half is unfolded outwards over the square's edges:

    p = d / (|x|+|y|+|z|);   (u, v) = (p_x, p_y)                                   where z ≥ 0
                             (u, v) = ((1−|p_y|)·sign p_x, (1−|p_x|)·sign p_y)     where z < 0

In a map of S×S texels the centre of texel (i, j) (row i, column j) is at u = (2j+1)/S − 1, v = (2i+1)/S − 1. The neighbour across an edge
of the square is the mirrored texel of the same edge, so a border of one texel makes bilinear interpolation seamless.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.geometry.vectors import unit
from gsbake.shading.cubemap import Array, Index

#: Lower bound of |x|+|y|+|z| in the projection; shorter vectors are not normalised.
MIN_L1_NORM = 0.05


def decode(uv: Array) -> Array:
    """Unit directions (…, 3) of octahedral coordinates (…, 2) in [−1, 1]."""
    u, v = uv[..., 0], uv[..., 1]
    z = 1.0 - np.abs(u) - np.abs(v)
    x = np.where(z >= 0, u, (1.0 - np.abs(v)) * np.where(u >= 0, 1.0, -1.0))
    y = np.where(z >= 0, v, (1.0 - np.abs(u)) * np.where(v >= 0, 1.0, -1.0))
    return unit(np.stack([x, y, z], axis=-1))


def encode(dirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Octahedral coordinates u, v (n,) in [−1, 1] of directions (n, 3).

    The result does not depend on the length if |x|+|y|+|z| > `MIN_L1_NORM`. For shorter vectors it is undefined but finite, with finite
    gradients.
    """
    x, y, z = dirs.unbind(-1)
    inverse = 1.0 / (x.abs() + y.abs() + z.abs()).clamp_min(MIN_L1_NORM)
    p, q = x * inverse, y * inverse
    one = torch.ones_like(p)
    below = z < 0
    u = torch.where(below, (1.0 - q.abs()) * torch.where(p >= 0, one, -one), p)
    v = torch.where(below, (1.0 - p.abs()) * torch.where(q >= 0, one, -one), q)
    return u, v


def encode_array(directions: Array) -> tuple[Array, Array]:
    """Octahedral coordinates u, v (n,) in [−1, 1] of directions (n, 3), as `encode`."""
    u, v = encode(torch.from_numpy(np.ascontiguousarray(directions)))
    return u.numpy(), v.numpy()


def texel_directions(size: int) -> Array:
    """Unit directions (size², 3) of the texel centres, in row-major order."""
    x = (2.0 * np.arange(size) + 1.0) / size - 1.0
    v, u = np.meshgrid(x, x, indexing="ij")
    return decode(np.stack([u, v], axis=-1)).reshape(-1, 3)


def texel_index(size: int, dirs: Array) -> Index:
    """Flat index (n,) of the texel that contains each direction (n, 3)."""
    u, v = encode_array(dirs)
    col = np.clip(((u + 1.0) * 0.5 * size).astype(np.int64), 0, size - 1)
    row = np.clip(((v + 1.0) * 0.5 * size).astype(np.int64), 0, size - 1)
    return row * size + col


def border_indices(size: int) -> NDArray[np.int64]:
    """Flat indices (size+2, size+2) of the texels of the map without border that fill the map with border."""
    row, col = np.meshgrid(np.arange(-1, size + 1), np.arange(-1, size + 1), indexing="ij")
    over = (col < 0) | (col >= size)
    row = np.where(over, size - 1 - row, row)
    col = np.clip(col, 0, size - 1)
    # Corners are beyond two edges: the second fold mirrors the column too.
    over = (row < 0) | (row >= size)
    col = np.where(over, size - 1 - col, col)
    row = np.clip(row, 0, size - 1)
    return np.asarray(row * size + col)
