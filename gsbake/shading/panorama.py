"""Equirectangular environment images: conventions and sampling.

Images are (h, 2h, 3) with the zenith in row 0; the centre of pixel (i, j) (row, column) is at u = (j + ½)/2h from left to right and
v = 1 − (i + ½)/h from bottom to top. Two conventions map (u, v) to directions; both show the world from inside, not mirrored:

`blender`, Z-up (Cycles' equirectangular mapping):   u = ½ − atan2(y, x)/2π,   v = atan2(z, √(x² + y²))/π + ½
    centre of the image +X, at u = ¼ +Y, at u = ¾ −Y, at the left and right edges −X.

`gltf`, Y-up (three.js and the Khronos sample viewer):   u = atan2(z, x)/2π + ½,   v = asin(y)/π + ½
    centre of the image +X, at u = ¼ −Z, at u = ¾ +Z, at the edges −X.

glTF's (x, y, z) is Blender's (x, −z, y), as its importer converts meshes: both conventions are the same, and one file serves both.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsbake.shading.cubemap import Array

Convention = Literal["blender", "gltf"]


def directions(height: int, convention: Convention = "blender", subdivide: int = 1) -> Array:
    """Unit directions (height·k, 2·height·k, 3) of the centres of pixels subdivided into k × k parts."""
    rows = height * subdivide
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = 2.0 * np.pi * ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5)[None, :]
    forward, right, up = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    up = np.broadcast_to(up, forward.shape)
    return np.stack([forward, -right, up] if convention == "blender" else [forward, up, right], axis=-1)


def coordinates(dirs: Array, convention: Convention = "blender") -> tuple[Array, Array]:
    """u from left to right and v from bottom to top, (n,) each in [0, 1], of directions (n, 3)."""
    x, y, z = dirs.T
    if convention == "blender":
        forward, right, up = x, -y, z
    else:
        forward, right, up = x, z, y
    return np.arctan2(right, forward) / (2.0 * np.pi) + 0.5, np.arctan2(up, np.hypot(forward, right)) / np.pi + 0.5


def sample(image: NDArray[np.floating], dirs: Array, convention: Convention = "blender") -> Array:
    """Values (n, c) of an equirectangular image (h, w, c) at directions (n, 3), bilinear, wrapped horizontally and clamped at the poles."""
    height, width = image.shape[:2]
    u, v = coordinates(dirs, convention)
    x, y = u * width - 0.5, np.clip((1.0 - v) * height - 0.5, 0, height - 1)
    col, row = np.floor(x).astype(np.int64), np.minimum(np.floor(y).astype(np.int64), max(height - 2, 0))
    fx, fy = (x - col)[:, None], (y - row)[:, None]
    left, right, below = col % width, (col + 1) % width, np.minimum(row + 1, height - 1)
    top = (1.0 - fx) * image[row, left] + fx * image[row, right]
    return np.asarray((1.0 - fy) * top + fy * ((1.0 - fx) * image[below, left] + fx * image[below, right]))
