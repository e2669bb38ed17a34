"""Prefiltering as one constant linear operator: cube-map radiance in, a stack of octahedral maps out.

The split-sum approximation (Karis, *Real Shading in Unreal Engine 4*, 2013) looks up the light convolved with the GGX lobe seen head-on
(n = v = r), weighted by n·l:  L(r, α) = Σ (n·l) L(l) / Σ (n·l) over half-vectors drawn from D(h)(n·h). Diffuse shading looks up the
irradiance divided by π, so that a white Lambertian surface under radiance 1 returns 1. Both are linear in the radiance, so their weights
are computed once per map size and every training step costs two sparse matrix products.

How the weights are found: a lobe wider than the cube map's texels is summed over the texels of a cube-map pyramid, fine ones at its peak
and coarse ones in its tails, level by level with smooth shares. A narrower lobe draws a fixed low-discrepancy set of directions and reads
each bilinearly from the level whose texels match the sample's own solid angle (Křivánek & Colbert, *Real-time Shading with Filtered
Importance Sampling*, EGSR 2008). The cube and the octahedron share their reflections, so only the octant x, y, z ≥ 0 is computed and the
other seven mirror its columns: no direction is treated differently from another.
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

#: Roughness of the levels: .08 to .5 as in METHOD, .7 so that the interpolation up to 1 stays within a few %, and 1. At roughness 1 the
#: head-on GGX density is constant, so the n·l weighted lobe *is* the cosine lobe and the last level is the irradiance divided by π.
ROUGHNESS = (0.08, 0.16, 0.26, 0.38, 0.5, 0.7, 1.0)

#: Edge of the sharpest octahedral map per unit of cube edge: its texels are then no wider than the cube's anywhere.
_SHARPEST = 3.0

#: Octahedral texels across the square root of a lobe's solid angle 4πα², and the least edge (bilinear lookup within a few %).
_LOBE_TEXELS = 2.2
_SMOOTHEST = 24

#: Largest octahedral map.
_LARGEST = 512

#: Weights below this are dropped (rows sum to 1 and are normalised again afterwards).
_NEGLIGIBLE = 1e-4

#: Width of the texels a kernel is summed over, as a share of the scale on which it bends.
_STEP = 0.5

#: Lobes with α below this over the map's edge are narrower than its texels: their own directions are sampled, this many.
_NARROW = 1.0
_NARROW_SAMPLES = 64


@dataclass(frozen=True)
class Layout:
    """Where the levels lie in the flat table, by growing roughness; the last one doubles as irradiance / π.

    `sizes` are inner edges; each level is stored with its border, (size + 2)² texels from `offsets`, row by row; `texels` is the table's
    length.
    """

    roughness: tuple[float, ...]
    sizes: tuple[int, ...]
    offsets: tuple[int, ...]
    texels: int


@dataclass(frozen=True, eq=False)
class Operator:
    """table = weights @ [radiance; reduce @ radiance], radiance flattened to (6·size², 3)."""

    size: int
    layout: Layout
    reduce: scipy.sparse.csr_matrix
    weights: scipy.sparse.csr_matrix


def ggx_lobe(alpha: float, count: int) -> tuple[Array, Array, Array]:
    """Directions (k, 3) around +Z of the head-on GGX lobe, their weights (k,) and densities per steradian (k,).

    tan²θ_h = α² u/(1−u) (Walter et al., EGSR 2007), on a Vogel spiral; light is the mirrored view, so θ = 2θ_h; pdf(l) = D/4 for v = n.
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


def frames(axes: Array) -> Array:
    """Rotations (n, 3, 3) whose third column is each unit axis (n, 3); Duff et al., *Building an Orthonormal Basis*, JCGT 2017."""
    x, y, z = axes.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([first, second, axes], axis=2)


def pyramid_sizes(size: int) -> tuple[int, ...]:
    """Edges of the cube-map pyramid, the full one first, each about half the one before, down to 8 or so."""
    sizes = [size]
    while sizes[-1] >= 16:
        sizes.append((sizes[-1] + 1) // 2)
    return tuple(sizes)


def level_sizes(size: int) -> tuple[int, ...]:
    """Edges of the octahedral maps, all even: fine enough for the cube at the sharp end, for the lobe at the wide one."""
    sizes = []
    for roughness in ROUGHNESS:
        width = math.sqrt(4.0 * math.pi) * roughness**2  # square root of the lobe's solid angle 1/pdf(0)
        texels = min(_SHARPEST * size, 4.0 * _LOBE_TEXELS / width, _LARGEST)
        sizes.append(2 * math.ceil(max(texels, _SMOOTHEST) / 2))
    return tuple(sizes)


def _lobe_rows(size: int, axes: Array, lobe: tuple[Array, Array, Array]) -> scipy.sparse.csr_matrix:
    """Weights (n, all pyramid texels) of one lobe around axes (n, 3)."""
    sizes = pyramid_sizes(size)
    local, weight, density = lobe
    weight = weight / weight.sum()
    dirs = np.einsum("nij,kj->nki", frames(axes), local).reshape(-1, 3)
    row = np.repeat(np.arange(len(axes)), len(local))
    value = np.tile(weight, len(axes))
    _, s, t = cubemap.locate(dirs)
    texel_angle = 4.0 / size**2 / (1.0 + s * s + t * t) ** 1.5
    ratio = 1.0 / (len(local) * np.tile(density, len(axes)) * texel_angle)
    level = np.clip(np.floor(0.5 * np.log2(ratio)), 0, len(sizes) - 1).astype(np.int64)
    blocks = []
    for k, edge in enumerate(sizes):
        here = np.flatnonzero(level == k)
        index, share = cubemap.padded_taps(edge, dirs[here])
        values = (share * value[here, None]).ravel()
        shape = (len(axes), 6 * (edge + 2) ** 2)
        taps = scipy.sparse.coo_matrix((values, (np.repeat(row[here], 4), index.ravel())), shape=shape).tocsr()
        blocks.append(taps @ cubemap.padding(edge))
    return scipy.sparse.hstack(blocks, format="csr")


def _quadrature_rows(size: int, axes: Array, alpha: float) -> scipy.sparse.csr_matrix:
    """Weights (n, all pyramid texels) of the GGX lobe of `alpha` around axes (n, 3), by quadrature over texels.

    At an angle θ the kernel bends over a scale ∝ √(α² + tan²θ/2): the texels used there are about `_STEP` times that wide. Neighbouring
    pyramid levels share the kernel by linear weights in the logarithm of the scale, so every level sums a smooth function.
    """
    sizes = pyramid_sizes(size)
    full_width = math.sqrt(4.0 * math.pi / 6.0) / size
    tree = cKDTree(axes)
    blocks = []
    for k, edge in enumerate(sizes):
        dirs = cubemap.directions(edge).reshape(-1, 3)
        # Level k has a share up to the angle where the scale calls for level k + 1; the last one serves the whole hemisphere.
        reach = 1.0 if k == len(sizes) - 1 else 2.0 ** (k + 1) * full_width / _STEP
        chord = min(2.0 * math.sin(math.atan(reach)), math.sqrt(2.0))
        near = tree.sparse_distance_matrix(cKDTree(dirs), chord, output_type="ndarray")
        sin2 = near["v"] ** 2 / 4.0  # sin²(θ/2), from the chord 2 sin(θ/2)
        scale = np.sqrt(alpha * alpha + sin2 / (1.0 - sin2))
        level = np.clip(np.log2(_STEP * scale / full_width), 0, len(sizes) - 1)
        share = np.clip(1.0 - np.abs(level - k), 0.0, None)
        cos_l = np.clip(1.0 - 2.0 * sin2, 0.0, None)
        lobe = cos_l / ((1.0 - sin2) * (alpha * alpha - 1.0) + 1.0) ** 2
        weight = share * lobe * cubemap.solid_angles(edge).ravel()[near["j"]]
        blocks.append(scipy.sparse.coo_matrix((weight, (near["i"], near["j"])), shape=(len(axes), len(dirs))))
    return scipy.sparse.hstack(blocks, format="csr")


def _mirrors(size: int) -> list[tuple[Array, Index]]:
    """The eight sign patterns (3,), each with the permutation that takes a pyramid texel to its mirror image."""
    out = []
    for pattern in range(8):
        sign = np.array([1.0 - 2.0 * (pattern >> k & 1) for k in range(3)])
        columns, start = [], 0
        for edge in pyramid_sizes(size):
            columns.append(start + cubemap.texel(edge, cubemap.directions(edge).reshape(-1, 3) * sign))
            start += 6 * edge * edge
        out.append((sign, np.concatenate(columns)))
    return out


def _level(size: int, edge: int, alpha: float, mirrors: list[tuple[Array, Index]]) -> scipy.sparse.csr_matrix:
    """Weights of one bordered octahedral level, ((edge+2)², all pyramid texels)."""
    dirs = octahedral.texel_directions(edge)
    canonical = octahedral.texel(edge, np.abs(dirs))
    octant, inverse = np.unique(canonical, return_inverse=True)
    axes = np.abs(dirs[octant])
    if alpha > _NARROW / size:
        base = _quadrature_rows(size, axes, alpha)
    else:
        lobe = ggx_lobe(alpha, _NARROW_SAMPLES)
        step = 8192  # rows at a time, to bound memory
        base = scipy.sparse.vstack([_lobe_rows(size, axes[i : i + step], lobe) for i in range(0, len(axes), step)], format="csr")
    base.data[base.data < _NEGLIGIBLE] = 0.0
    base.eliminate_zeros()
    base = (scipy.sparse.diags(1.0 / np.asarray(base.sum(axis=1)).ravel()) @ base).tocsr()
    negative = (dirs < -1e-9) @ np.array([1, 2, 4])
    order, parts = [], []
    for pattern, (_, columns) in enumerate(mirrors):
        rows_here = np.flatnonzero(negative == pattern)
        order.append(rows_here)
        parts.append(base[inverse[rows_here]][:, columns])
    plain = scipy.sparse.vstack(parts, format="csr")[np.argsort(np.concatenate(order))]
    return plain[octahedral.bordered(edge).ravel()]


@lru_cache(maxsize=4)
def operator(size: int) -> Operator:
    """The prefilter of cube maps (6, size, size, 3); computed once per process and size."""
    if size < 4:
        raise ValueError(f"an environment cube map needs at least 4 texels per edge, not {size}")
    sizes = level_sizes(size)
    mirrors = _mirrors(size)
    levels = []
    for roughness, edge in zip(ROUGHNESS, sizes, strict=True):
        levels.append(_level(size, edge, roughness**2, mirrors))
    counts = [(edge + 2) ** 2 for edge in sizes]
    offsets = tuple(int(o) for o in np.cumsum([0, *counts[:-1]]))
    coarse = [cubemap.reduction(size, edge) for edge in pyramid_sizes(size)[1:]]
    reduce = scipy.sparse.vstack(coarse, format="csr") if coarse else scipy.sparse.csr_matrix((0, 6 * size * size))
    return Operator(size, Layout(ROUGHNESS, sizes, offsets, sum(counts)), reduce, scipy.sparse.vstack(levels, format="csr"))
