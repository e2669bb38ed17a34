"""Reflectance sparsity prior: an object is made of few materials.

Where photos leave a texel's material open, it is most likely one that many other texels have. One step of mean shift in the space of base
colour and roughness, with a Gaussian kernel, moves each material uphill in the density of all texels' materials; the fit draws texels to
the result. Materials close together (one plastic with residual reflections) merge; where their density is uniform (the skin of a fruit)
the local mean is the material itself, and nothing moves.

Barron & Malik, *Shape, illumination, and reflectance from shading*, PAMI 2015 (low entropy of reflectances);
Comaniciu & Meer, *Mean shift: a robust approach toward feature space analysis*, PAMI 2002; sums are kept on a coarse grid as by Chen, Paris
& Durand, *Real-time edge-aware image processing with the bilateral grid*, SIGGRAPH 2007.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.imaging.srgb import encode
from gsbake.materials.surface import Materials

Floats = NDArray[np.float32]

#: Standard deviations of the kernel: three of base colour (sRGB 0..1) and one of roughness.
KERNEL_WIDTHS = (0.03, 0.03, 0.03, 0.1)
#: Texels from this metallic on count as metal; metals and dielectrics have separate densities.
METAL_THRESHOLD = 0.5


def common_materials(materials: Materials, included: NDArray[np.bool_]) -> Floats:
    """The local mean of the `materials` around each texel, (n, 4): base colour in sRGB and roughness.

    Texels that are not `included` (n,) do not enter the density and keep their own material.
    """
    common = np.column_stack([encode(np.clip(materials.base_color, 0, 1)), materials.roughness])
    metal = materials.metallic >= METAL_THRESHOLD
    for kind in (included & metal, included & ~metal):
        common[kind] = mean_shift(common[kind], KERNEL_WIDTHS)
    return np.asarray(common, np.float32)


def mean_shift(values: NDArray[np.floating], widths: tuple[float, ...]) -> Floats:
    """For each of `values` (n, k) the mean (n, k) of all, weighted by a Gaussian of their distance.

    Its standard deviations are `widths` (k,), and a sixth more: sums are taken on a grid with cells of one deviation, by linear splatting
    and slicing.
    """
    if not len(values):
        return np.zeros(values.shape, np.float32)
    values = np.asarray(values, np.float64)
    position = (values - values.min(0)) / np.asarray(widths)
    low = np.floor(position).astype(np.int64)
    fraction = position - low
    shape = tuple(low.max(0) + 2)
    columns = np.column_stack([values, np.ones(len(values))]).T
    sums = np.zeros((len(columns), int(np.prod(shape))))
    corners = []
    for corner in product((0, 1), repeat=values.shape[1]):
        cell = np.ravel_multi_index(tuple((low + corner).T), shape)
        weight = np.where(np.asarray(corner, bool), fraction, 1 - fraction).prod(1)
        corners.append((cell, weight))
        for total, column in zip(sums, columns, strict=True):
            total += np.bincount(cell, weight * column, len(total))
    sliced = np.zeros(columns.shape)
    for total, out in zip(sums, sliced, strict=True):
        smooth = ndimage.gaussian_filter(total.reshape(shape), 1.0, mode="constant").ravel()
        for cell, weight in corners:
            out += weight * smooth[cell]
    return np.asarray((sliced[:-1] / sliced[-1]).T, np.float32)
