"""The surface of a fit: texels of a texture with their geometry, neighbours and light transport, at the three resolutions of the fit.

The fit works on a texture of about a pixel of the photos per texel, and on one of half its edge with a quarter of the pixels, on which
searches are made; starts are compared on one of half the edge of that. Visibility and indirect light vary slowly over the surface: they are
traced on the coarser textures, and interpolated on the finest. Neighbours are texels that share an edge in the texture, and texels across
seams between charts.

Texels of similar appearance decide together: averages of texel values over the surface stop at edges of its appearance. The average u of
values f solves (1 + L) u = f, where L is the Laplacian of the graph of neighbouring texels, across seams included; edge weights fall with
the change of appearance, such as colour. Two by two texels are one node; the system is factored once and solved for every f.

Farbman, Fattal, Lischinski & Szeliski, *Edge-preserving decompositions for multi-scale tone and detail manipulation*, SIGGRAPH 2008
(weighted least squares).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.imaging.srgb import encode
from gsbake.texturing.resampling import CoarseTexture
from gsbake.texturing.texels import Texels


@dataclass(frozen=True)
class FilterOptions:
    """Constants of the edge-aware filter."""

    #: Change of colour (sRGB, sum of channels) between adjacent texels over which a wide and a near neighbourhood extend, and the factor on
    #: a change of roughness beside it.
    wide_scale: float = 0.3
    near_scale: float = 0.15
    roughness_factor: float = 0.5
    #: Width in texels of the smoothing of appearance before they are compared: fine patterns are one material.
    prefilter_width: float = 2.0
    #: Variance, in square texels, that averaging a texel with its four neighbours adds along either axis.
    averaging_variance: float = 0.4
    #: Edge of a graph node in texels.
    node_size: int = 2


OPTIONS = FilterOptions()

#: Radius of the filter on a uniform surface, in texels.
FILTER_RADIUS = 60.0


class EdgeAwareFilter:
    """The filter on `texels` with an `appearance` (n, c) of any channels and neighbouring `pairs` (m, 2).

    A change by `scale`, summed over channels, between adjacent texels is as far as the whole radius.
    """

    def __init__(self, texels: Texels, pairs: NDArray[np.int64], appearance: NDArray[np.float32], scale: float) -> None:
        smooth = _prefiltered(appearance, pairs)
        row, column = np.divmod(texels.index, texels.size)
        self._node = np.unique(row // OPTIONS.node_size * texels.size + column // OPTIONS.node_size, return_inverse=True)[1]
        size = np.bincount(self._node)
        smooth = np.stack([np.bincount(self._node, c) for c in smooth.T], 1) / size[:, None]
        edge = np.sort(self._node[pairs], axis=1)
        edge = np.unique(edge[edge[:, 0] != edge[:, 1]], axis=0)
        change = np.abs(smooth[edge[:, 0]] - smooth[edge[:, 1]]).sum(1) / OPTIONS.node_size
        weight = (FILTER_RADIUS / (1 + FILTER_RADIUS / scale * change)) ** 2
        graph = _symmetric(edge, weight, len(size))
        degree = scipy.sparse.diags(np.asarray(graph.sum(1)).ravel() + size)
        # The matrix is symmetric and diagonally dominant: no pivoting is needed.
        self._factor = scipy.sparse.linalg.splu(
            (degree - graph).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def __call__(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """`values` (n,) averaged over the neighbourhood of similar appearance of each texel."""
        return np.asarray(self._factor.solve(np.bincount(self._node, np.asarray(values, np.float64)))[self._node])


class Neighbourhoods:
    """The neighbourhoods of texels that decide together, on `texels` with neighbouring `pairs` (m, 2) and the photos' linear colours
    `photographed` (n, 3)."""

    def __init__(self, texels: Texels, pairs: NDArray[np.int64], photographed: NDArray[Any]) -> None:
        self._texels, self._pairs, self._photographed = texels, pairs, photographed

    @cached_property
    def wide(self) -> EdgeAwareFilter:
        """The filter over texels of similar colour in photos; built on first use."""
        colour = encode(np.clip(np.asarray(self._photographed, np.float32), 0, 1))
        return EdgeAwareFilter(self._texels, self._pairs, colour, OPTIONS.wide_scale)

    def near(self, base_color: NDArray[np.float32], roughness: NDArray[np.float32]) -> EdgeAwareFilter:
        """The filter over texels of nearly the same material: linear `base_color` (n, 3) and `roughness` (n,)."""
        material = np.column_stack([encode(base_color), OPTIONS.roughness_factor * roughness])
        return EdgeAwareFilter(self._texels, self._pairs, material, OPTIONS.near_scale)


def _prefiltered(values: NDArray[np.float32], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """`values` (n, c) smoothed over about `prefilter_width` texels of the surface."""
    adjacency = _symmetric(pairs, np.ones(len(pairs)), len(values))
    count = 1 + np.asarray(adjacency.sum(1)).ravel()
    out = np.asarray(values, np.float64)
    for _ in range(round(OPTIONS.prefilter_width**2 / OPTIONS.averaging_variance)):
        out = (out + adjacency @ out) / count[:, None]
    return out


def _symmetric(pairs: NDArray[np.int64], weight: NDArray[np.float64], n: int) -> scipy.sparse.csr_matrix:
    """The symmetric matrix (n, n) with `weight` (m,) at the `pairs` (m, 2)."""
    upper = scipy.sparse.csr_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return upper + upper.T


Floats = NDArray[np.float32]
Pairs = NDArray[np.int64]


class Transport(Protocol):
    """Visibility and indirect light of the texels; see `gsbake.materials.visibility.Visibility`."""

    def visible_share(self, radiance: Floats) -> Floats:
        """Unoccluded share (n,) of the irradiance by luminance under the cube map `radiance`."""

    def indirect_irradiance(self, irradiance: Floats, reflectance: Floats) -> Floats:
        """Indirect irradiance / π (n, 3) of texels with `reflectance` (n, 3) under direct `irradiance` / π (n, 3)."""


@dataclass(frozen=True)
class Surface:
    """The n texels of a texture with their geometry.

    `position`, unit `normal` (n, 3) in the mesh's frame; `pairs` (m, 2) neighbouring texels, see `neighbours`; `occlusion` (n,) ambient
    occlusion, 1 = open; `base_color` (n, 3) the initial linear base colour. With `transport` shadows follow the light, with `indirect`
    texels light each other as well.
    """

    texels: Texels
    position: Floats
    pairs: Pairs
    normal: Floats
    occlusion: Floats
    base_color: Floats
    transport: Transport | None = None
    indirect: bool = True

    @cached_property
    def neighbourhoods(self) -> Neighbourhoods:
        """The neighbourhoods of texels that decide together; kept, as all searches on a level use the same wide one."""
        return Neighbourhoods(self.texels, self.pairs, self.base_color)

    @cached_property
    def neighbour_lists(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """The neighbours of each texel: `start` (n + 1,) and the list they lie in."""
        return neighbour_lists(self.pairs, len(self.texels))

    @cached_property
    def unit_normals(self) -> Floats:
        """The mesh's unit normals (n, 3) at the texels."""
        normal = np.asarray(self.normal, np.float32)
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)

    def coarse(self, texture: CoarseTexture) -> Surface:
        """The texels averaged onto the coarse ones of `texture`, without light transport."""
        normal, occlusion, base, position = (
            texture.down(x) for x in (self.normal, self.occlusion[:, None], self.base_color, self.position)
        )
        pairs = neighbours(texture.texels, position, normal)
        return replace(
            self, texels=texture.texels, position=position, pairs=pairs, normal=normal, occlusion=occlusion[:, 0], base_color=base,
            transport=None,
        )  # fmt: skip


@dataclass(frozen=True)
class InterpolatedTransport:
    """Visibility and indirect light of the fine texels of `texture`, computed by `coarse` on its coarse texels."""

    coarse: Transport
    texture: CoarseTexture

    def visible_share(self, radiance: Floats) -> Floats:
        """See `Visibility.visible_share`."""
        return self.texture.up(self.coarse.visible_share(radiance)[:, None])[:, 0]

    def indirect_irradiance(self, irradiance: Floats, reflectance: Floats) -> Floats:
        """See `Visibility.indirect_irradiance`."""
        return self.texture.up(self.coarse.indirect_irradiance(self.texture.down(irradiance), self.texture.down(reflectance)))


@dataclass(frozen=True)
class AdjacencyOptions:
    """Which texels are neighbours. At a seam the texels of either chart reach its border, so a texel of one lies within about a texel's
    width of one of the other, though far from it in the texture. Texels of two charts that are merely packed side by side are not
    adjacent."""

    #: Largest distance of neighbours within a chart and across a seam, in median distances of adjacent texels.
    chart_distance: float = 4.0
    seam_distance: float = 1.5
    #: Candidates across the seam for every texel at a chart's border, and their least distance in the texture in texels.
    seam_candidates: int = 8
    texture_distance: int = 4
    #: Least cosine of normals across a seam: the other side of a thin sheet is another surface.
    normal_cosine: float = 0.5
    #: Pairs are shuffled in blocks of about this many, for memory locality.
    shuffle_block: int = 256


_ADJACENCY = AdjacencyOptions()


def neighbours(texels: Texels, position: NDArray[np.floating], normal: NDArray[np.floating]) -> Pairs:
    """Pairs (m, 2) of adjacent texels at `position` (n, 3) with `normal` (n, 3) of any length, in a fixed shuffled order."""
    p = np.asarray(position, np.float64)
    grid = _grid_neighbours(texels)
    distance = np.linalg.norm(p[grid[:, 0]] - p[grid[:, 1]], axis=1)
    width = float(np.median(distance)) if len(distance) else 0.0
    grid = grid[distance <= _ADJACENCY.chart_distance * width]
    pairs = np.concatenate([grid, _seam_neighbours(texels, p, np.asarray(normal, np.float64), grid, _ADJACENCY.seam_distance * width)])
    blocks = np.array_split(pairs, max(1, len(pairs) // _ADJACENCY.shuffle_block))
    np.random.default_rng(0).shuffle(blocks)
    return np.concatenate(blocks) if blocks else pairs


def _grid_neighbours(texels: Texels) -> Pairs:
    """Pairs (m, 2) that share an edge in the texture."""
    index = texels.lookup.reshape(texels.size, texels.size)
    pairs = []
    for a, b in ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:])):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]], 1))
    return np.concatenate(pairs)


def _seam_neighbours(texels: Texels, position: NDArray[np.float64], normal: NDArray[np.float64], grid: Pairs, radius: float) -> Pairs:
    """Pairs (m, 2) of border texels of different charts within `radius`; `grid` are the pairs within charts."""
    border = np.flatnonzero(np.bincount(grid.ravel(), minlength=len(texels)) < 4)
    if len(border) < 2 or not radius > 0:
        return np.zeros((0, 2), np.int64)
    count = min(_ADJACENCY.seam_candidates, len(border))
    distance, found = cKDTree(position[border]).query(position[border], k=count, distance_upper_bound=radius)
    first, near = np.repeat(border, distance.shape[1]), np.isfinite(distance.ravel())
    first, second = first[near], border[found.ravel()[near]]
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    row, column = np.divmod(texels.index, texels.size)
    far = np.maximum(np.abs(row[first] - row[second]), np.abs(column[first] - column[second])) >= _ADJACENCY.texture_distance
    same_side = np.einsum("nd,nd->n", unit[first], unit[second]) > _ADJACENCY.normal_cosine
    return np.unique(np.sort(np.stack([first, second], 1)[far & same_side], axis=1), axis=0)


def neighbour_lists(pairs: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The neighbours of each of `count` texels in the `pairs` (m, 2): `start` (count + 1,) and the list they lie in."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.argsort(both[:, 0], kind="stable")
    start = np.searchsorted(both[order, 0], np.arange(count + 1))
    return start, both[order, 1].astype(np.int32)


@dataclass(frozen=True)
class Materials:
    """Materials of n texels: linear `base_color` (n, 3), `roughness` and `metallic` (n,); `normal_offset` (n, 3) to be added to the unit
    normal, and emitted radiance `emission` (n, 3), where there are such."""

    base_color: Floats
    roughness: Floats
    metallic: Floats
    normal_offset: Floats | None = None
    emission: Floats | None = None

    def __len__(self) -> int:
        return len(self.roughness)

    def of(self, texel: NDArray[np.int64] | NDArray[np.bool_]) -> Materials:
        """Base colour, roughness and metallic of some texels."""
        return Materials(self.base_color[texel], self.roughness[texel], self.metallic[texel])

    def copied(self) -> Materials:
        """A copy, which does not change with the arrays of this one."""
        return replace(self, **{name: array.copy() for name, array in vars(self).items() if array is not None})
