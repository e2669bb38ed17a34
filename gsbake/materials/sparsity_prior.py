"""What the object is made of: few materials, used again and again.

Where photos leave open how bright or how rough a texel is, it most likely is what many others are. The density of all texels' materials
says which are common, and the way up that density is towards the mean of the materials near by, each weighed by a Gaussian of its distance:
a mean shift. So texels are drawn to that mean. Where materials lie close together (one plastic, made uneven by reflections left over) they
become one; where they spread evenly (the skin of a fruit) the mean of those near by is what is there already, and nothing moves.

Barron & Malik, *Shape, illumination, and reflectance from shading*, PAMI 2015 (parsimony: few reflectances, a low entropy of them all);
Comaniciu & Meer, *Mean shift: a robust approach toward feature space analysis*, PAMI 2002; sums are kept on a coarse grid as by Chen, Paris
& Durand, *Real-time edge-aware image processing with the bilateral grid*, SIGGRAPH 2007.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.imaging.srgb import encode

Floats = NDArray[np.float32]

#: Standard deviations within which materials are near: three of base colour (sRGB) and one of roughness.
NEAR = (0.03, 0.03, 0.03, 0.1)
#: What is at least as metallic as this is near to metals alone, the rest to paint alone.
METAL = 0.5


def common(values: NDArray[Any], counted: NDArray[np.bool_]) -> Floats:
    """The material common around that of each texel, (n, 4): base colour in sRGB and roughness.

    `values` (n, 5) are linear base colour, roughness and metallic. Texels that are not `counted` (n,) count for nothing and get their own.
    """
    own = np.column_stack([encode(np.clip(values[:, :3], 0, 1)), values[:, 3]])
    metal = values[:, 4] >= METAL
    for kind in (counted & metal, counted & ~metal):
        own[kind] = shifted(own[kind], NEAR)
    return np.asarray(own, np.float32)


def shifted(values: NDArray[Any], widths: tuple[float, ...]) -> Floats:
    """For each of `values` (n, k) the mean (n, k) of all of them, weighed by a Gaussian of their distance.

    Its standard deviations are `widths` (k,), and a sixth more: sums are taken on a grid of one deviation that is written and read
    linearly.
    """
    if not len(values):
        return np.zeros(values.shape, np.float32)
    values = np.asarray(values, np.float64)
    place = (values - values.min(0)) / np.asarray(widths)
    low = np.floor(place).astype(np.int64)
    part = place - low
    shape = tuple(low.max(0) + 2)
    columns = np.column_stack([values, np.ones(len(values))]).T
    sums = np.zeros((len(columns), int(np.prod(shape))))
    corners = []
    for corner in product((0, 1), repeat=values.shape[1]):
        cell = np.ravel_multi_index(tuple((low + corner).T), shape)
        share = np.where(np.asarray(corner, bool), part, 1 - part).prod(1)
        corners.append((cell, share))
        for total, column in zip(sums, columns, strict=True):
            total += np.bincount(cell, share * column, len(total))
    near = np.zeros(columns.shape)
    for total, read in zip(sums, near, strict=True):
        smooth = ndimage.gaussian_filter(total.reshape(shape), 1.0, mode="constant").ravel()
        for cell, share in corners:
            read += share * smooth[cell]
    return np.asarray((near[:-1] / near[-1]).T, np.float32)
