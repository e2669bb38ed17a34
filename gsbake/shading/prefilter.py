"""Prefiltering of environment maps as a constant linear operator from a cube map to octahedral maps.

The split-sum approximation (Karis, *Real Shading in Unreal Engine 4*, 2013) uses the light convolved with the GGX lobe at normal incidence
(n = v = r), weighted by n·l:  L(r, α) = Σ (n·l) L(l) / Σ (n·l) over half-vectors sampled from D(h)(n·h). Diffuse shading uses the
irradiance divided by π, so that a white Lambertian surface under radiance 1 has outgoing radiance 1. Both are linear in the radiance: the
weights are computed once per map size, and a training step costs two sparse matrix products.

Weights: lobes wider than the cube map's texels are integrated by quadrature over the texels of a cube-map pyramid, fine levels at the peak
and coarse levels in the tails, blended smoothly. Narrower lobes are sampled at a fixed low-discrepancy set of directions, each interpolated
bilinearly in the level whose texels match the sample's solid angle (Křivánek & Colbert, *Real-time Shading with Filtered Importance
Sampling*, EGSR 2008). Cube and octahedron share their mirror symmetries: the octant x, y, z ≥ 0 is computed, the other seven mirror it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree

from gsbake.shading import cubemap, octahedral
from gsbake.shading.cubemap import Array, Index

#: Roughness of the levels: .08 to .5 as in METHOD, .7 to keep the interpolation error up to 1 within a few %, and 1. At roughness 1 the
#: GGX density at normal incidence is constant, so the n·l weighted lobe is the cosine lobe and the last level is irradiance / π.
ROUGHNESS_LEVELS = (0.08, 0.16, 0.26, 0.38, 0.5, 0.7, 1.0)

#: Edge of the finest octahedral map relative to the edge of a cube face, so that its texels are nowhere larger than the cube's.
_FINEST_SCALE = 3.0

#: Octahedral texels across the square root of a lobe's solid angle 4πα², and minimum edge, for bilinear errors of a few %.
_LOBE_TEXELS = 2.2
_MIN_SIZE = 24

#: Maximum edge of an octahedral map.
_MAX_SIZE = 512

#: Smaller weights are dropped; rows sum to 1 and are normalised again afterwards.
_MIN_WEIGHT = 1e-4

#: Texel width of the quadrature relative to the local scale of the kernel.
_QUADRATURE_STEP = 0.5

#: Lobes with α below this value over the map's edge are narrower than its texels and are sampled, with this number of samples.
_SAMPLING_MAX_ALPHA = 1.0
_SAMPLE_COUNT = 64


@dataclass(frozen=True)
class Layout:
    """Layout of the levels in the flat table, by increasing roughness; the last level is also irradiance / π.

    `sizes` are edges without border; each level is stored with its border, (size + 2)² texels from `offsets` in row-major order; `texels`
    is the table's length.
    """

    roughness: tuple[float, ...]
    sizes: tuple[int, ...]
    offsets: tuple[int, ...]
    texels: int


@dataclass(frozen=True, eq=False)
class PrefilterOperator:
    """table = place @ (octant @ (mirror @ pyramid)) with pyramid = [radiance; reduce @ radiance], radiance flattened to (6·size², 3).

    Filters and map are symmetric about the three coordinate planes. So `octant` has the weights of the directions of one octant alone; it
    applies to the pyramid and its mirror images side by side, which `mirror` makes of it: rows pyramid texel · 8 + image. `place` takes
    each texel of the table from the rows direction · 8 + image of the result. That is an eighth of the weights, with the same sums.
    """

    size: int
    layout: Layout
    reduce: scipy.sparse.csr_matrix
    mirror: scipy.sparse.csr_matrix
    octant: scipy.sparse.csr_matrix
    place: scipy.sparse.csr_matrix


def ggx_lobe(alpha: float, count: int) -> tuple[Array, Array, Array]:
    """Sampled directions (k, 3) of the GGX lobe around +Z at normal incidence, weights (k,) and densities per steradian (k,).

    tan²θ_h = α² u/(1−u) (Walter et al., EGSR 2007), on a Vogel spiral. The light is the reflected view: θ = 2θ_h,
    pdf(l) = D/4 for v = n.
    """
    k = np.arange(count)
    u = (k + 0.5) / count
    cos2 = (1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u)
    cos_l = 2.0 * cos2 - 1.0
    keep = cos_l > 0
    phi = k * (math.pi * (3.0 - math.sqrt(5.0)))
    sin_l = np.sqrt(np.clip(1.0 - cos_l * cos_l, 0.0, None))
    dirs = np.stack([sin_l * np.cos(phi), sin_l * np.sin(phi), cos_l], axis=1)
    density = alpha**2 / (math.pi * (cos2 * (alpha * alpha - 1.0) + 1.0) ** 2)
    return dirs[keep], cos_l[keep], density[keep] / 4.0


def orthonormal_bases(axes: Array) -> Array:
    """Rotations (n, 3, 3) with the unit axes (n, 3) as third columns; Duff et al., *Building an Orthonormal Basis*, JCGT 2017."""
    x, y, z = axes.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([first, second, axes], axis=2)


def pyramid_sizes(size: int) -> tuple[int, ...]:
    """Edges of the cube-map pyramid from `size` down to about 8, each half of the previous one."""
    sizes = [size]
    while sizes[-1] >= 16:
        sizes.append((sizes[-1] + 1) // 2)
    return tuple(sizes)


def level_sizes(size: int) -> tuple[int, ...]:
    """Even edges of the octahedral maps: limited by the cube's resolution for narrow lobes, by the lobe's width for wide ones."""
    sizes = []
    for roughness in ROUGHNESS_LEVELS:
        width = math.sqrt(4.0 * math.pi) * roughness**2  # square root of the lobe's solid angle 1/pdf(0)
        texels = min(_FINEST_SCALE * size, 4.0 * _LOBE_TEXELS / width, _MAX_SIZE)
        sizes.append(2 * math.ceil(max(texels, _MIN_SIZE) / 2))
    return tuple(sizes)


def _sampled_rows(size: int, axes: Array, lobe: tuple[Array, Array, Array]) -> scipy.sparse.csr_matrix:
    """Weights (n, all pyramid texels) of a sampled lobe (`ggx_lobe`) around axes (n, 3)."""
    sizes = pyramid_sizes(size)
    local, weight, density = lobe
    weight = weight / weight.sum()
    dirs = np.einsum("nij,kj->nki", orthonormal_bases(axes), local).reshape(-1, 3)
    row = np.repeat(np.arange(len(axes)), len(local))
    value = np.tile(weight, len(axes))
    _, s, t = cubemap.locate(dirs)
    texel_angle = 4.0 / size**2 / (1.0 + s * s + t * t) ** 1.5
    ratio = 1.0 / (len(local) * np.tile(density, len(axes)) * texel_angle)
    level = np.clip(np.floor(0.5 * np.log2(ratio)), 0, len(sizes) - 1).astype(np.int64)
    blocks = []
    for k, edge in enumerate(sizes):
        selected = np.flatnonzero(level == k)
        index, share = cubemap.bilinear_taps(edge, dirs[selected])
        values = (share * value[selected, None]).ravel()
        shape = (len(axes), 6 * (edge + 2) ** 2)
        taps = scipy.sparse.coo_matrix((values, (np.repeat(row[selected], 4), index.ravel())), shape=shape).tocsr()
        blocks.append(taps @ cubemap.padding_matrix(edge))
    return scipy.sparse.hstack(blocks, format="csr")


def _quadrature_rows(size: int, axes: Array, alpha: float) -> scipy.sparse.csr_matrix:
    """Weights (n, all pyramid texels) of the GGX lobe of `alpha` around axes (n, 3), by quadrature over texels.

    At an angle θ the kernel varies over a scale ∝ √(α² + tan²θ/2); texels there are about `_QUADRATURE_STEP` times as wide. Adjacent
    pyramid levels are blended with linear weights in the logarithm of the scale, so that every level sums a smooth function.
    """
    sizes = pyramid_sizes(size)
    full_width = math.sqrt(4.0 * math.pi / 6.0) / size
    tree = cKDTree(axes)
    blocks = []
    for k, edge in enumerate(sizes):
        dirs = cubemap.directions(edge).reshape(-1, 3)
        # Level k contributes up to the angle where the scale requires level k + 1; the last one covers the whole hemisphere.
        reach = 1.0 if k == len(sizes) - 1 else 2.0 ** (k + 1) * full_width / _QUADRATURE_STEP
        chord = min(2.0 * math.sin(math.atan(reach)), math.sqrt(2.0))
        pairs = tree.sparse_distance_matrix(cKDTree(dirs), chord, output_type="ndarray")
        sin2 = pairs["v"] ** 2 / 4.0  # sin²(θ/2), from the chord 2 sin(θ/2)
        scale = np.sqrt(alpha * alpha + sin2 / (1.0 - sin2))
        level = np.clip(np.log2(_QUADRATURE_STEP * scale / full_width), 0, len(sizes) - 1)
        share = np.clip(1.0 - np.abs(level - k), 0.0, None)
        cos_l = np.clip(1.0 - 2.0 * sin2, 0.0, None)
        lobe = cos_l / ((1.0 - sin2) * (alpha * alpha - 1.0) + 1.0) ** 2
        weight = share * lobe * cubemap.solid_angles(edge).ravel()[pairs["j"]]
        blocks.append(scipy.sparse.coo_matrix((weight, (pairs["i"], pairs["j"])), shape=(len(axes), len(dirs))))
    return scipy.sparse.hstack(blocks, format="csr")


def _mirror_images(size: int) -> scipy.sparse.csr_matrix:
    """The matrix (8 · pyramid texels, pyramid texels) that gives every texel of the pyramid its eight mirror images; bit k of the image is
    a reflection along axis k."""
    images = []
    for image in range(8):
        sign = np.array([1.0 - 2.0 * (image >> k & 1) for k in range(3)])
        columns, start = [], 0
        for edge in pyramid_sizes(size):
            columns.append(start + cubemap.texel_index(edge, cubemap.directions(edge).reshape(-1, 3) * sign))
            start += 6 * edge * edge
        images.append(np.concatenate(columns))
    return _choice(np.stack(images, 1).ravel(), len(images[0]))


def _choice(index: Index, count: int) -> scipy.sparse.csr_matrix:
    """The matrix (n, count) that takes the rows `index` (n,)."""
    return scipy.sparse.csr_matrix((np.ones(len(index)), index, np.arange(len(index) + 1)), shape=(len(index), count))


def _level_rows(size: int, edge: int, alpha: float) -> tuple[scipy.sparse.csr_matrix, Index]:
    """Weights (directions, all pyramid texels) of one octahedral level in one octant, and direction · 8 + mirror image of each texel of the
    level with its border, ((edge+2)²,)."""
    dirs = octahedral.texel_directions(edge)
    canonical = octahedral.texel_index(edge, np.abs(dirs))
    octant, inverse = np.unique(canonical, return_inverse=True)
    axes = np.abs(dirs[octant])
    if alpha > _SAMPLING_MAX_ALPHA / size:
        base = _quadrature_rows(size, axes, alpha)
    else:
        lobe = ggx_lobe(alpha, _SAMPLE_COUNT)
        step = 8192  # rows per block, to limit memory
        base = scipy.sparse.vstack([_sampled_rows(size, axes[i : i + step], lobe) for i in range(0, len(axes), step)], format="csr")
    base.data[base.data < _MIN_WEIGHT] = 0.0
    base.eliminate_zeros()
    base = (scipy.sparse.diags(1.0 / np.asarray(base.sum(axis=1)).ravel()) @ base).tocsr()
    place = 8 * inverse + (dirs < -1e-9) @ np.array([1, 2, 4])
    return base, place[octahedral.border_indices(edge).ravel()]


@lru_cache(maxsize=4)
def prefilter_operator(size: int) -> PrefilterOperator:
    """The prefilter operator of cube maps (6, size, size, 3); computed once per process and size."""
    if size < 4:
        raise ValueError(f"an environment cube map needs at least 4 texels per edge, not {size}")
    sizes = level_sizes(size)
    levels, places, rows = [], [], 0
    for roughness, edge in zip(ROUGHNESS_LEVELS, sizes, strict=True):
        level, place = _level_rows(size, edge, roughness**2)
        levels.append(level)
        places.append(place + 8 * rows)
        rows += level.shape[0]
    counts = [(edge + 2) ** 2 for edge in sizes]
    offsets = tuple(int(o) for o in np.cumsum([0, *counts[:-1]]))
    coarse = [cubemap.downsampling_matrix(size, edge) for edge in pyramid_sizes(size)[1:]]
    reduce = scipy.sparse.vstack(coarse, format="csr") if coarse else scipy.sparse.csr_matrix((0, 6 * size * size))
    layout, place = Layout(ROUGHNESS_LEVELS, sizes, offsets, sum(counts)), _choice(np.concatenate(places), 8 * rows)
    return PrefilterOperator(size, layout, reduce, _mirror_images(size), scipy.sparse.vstack(levels, format="csr"), place)


@lru_cache(maxsize=4)
def irradiance_operator(size: int) -> PrefilterOperator:
    """The part of `prefilter_operator` that gives the last level, irradiance / π, alone."""
    op = prefilter_operator(size)
    layout, start = op.layout, op.layout.offsets[-1]
    place = op.place[start:]
    row = int(place.indices.min()) // 8
    last = Layout(layout.roughness[-1:], layout.sizes[-1:], (0,), layout.texels - start)
    return PrefilterOperator(size, last, op.reduce, op.mirror, op.octant[row:], place[:, 8 * row :])
