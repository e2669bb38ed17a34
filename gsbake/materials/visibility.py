"""Visibility and indirect light per texel, traced once for all environments: both are linear in the light.

Every texel samples the directions of one of `ROTATIONS` rotated copies of a Fibonacci sphere, assigned to neighbouring texels in a fixed
pattern (interleaved sampling), so that a small filter afterwards averages over all copies. Blocked rays are stored with their weight and
the texel they hit. An environment is summed over the cells around the directions, so that small light sources have their full power in
every texel; then

    blocked(t) = Σ_blocked cos · Ω/π · L(cell),    visible share = 1 − luminance(blocked) / luminance(all),
    indirect(t) = Σ_blocked cos · Ω/π · reflectance(hit) · E(hit),

all as irradiance / π, two sparse products per environment.

Sloan, Kautz & Snyder, *Precomputed radiance transfer*, SIGGRAPH 2002 (transfer linear in the light, interreflection included); Keller &
Heidrich, *Interleaved sampling*, EGWR 2001; Swinbank & Purser, *Fibonacci grids*, 2006.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse
from numba import prange
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.vectors import unit
from gsbake.imaging.srgb import LUMINANCE
from gsbake.kernels.declaration import kernel
from gsbake.shading import cubemap
from gsbake.texturing.ambient_occlusion import smooth_over_surface
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]

#: Edge of the interleaving pattern in texels; the filter of `smooth_over_surface` is at least as wide.
PATTERN_SIZE = 4
#: Rotated copies of the directions.
ROTATIONS = PATTERN_SIZE * PATTERN_SIZE
#: Diffuse bounces of indirect light.
BOUNCES = 2


@lru_cache(maxsize=4)
def directions(count: int) -> Floats:
    """Unit directions (ROTATIONS, count, 3), each copy uniform over the sphere."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    azimuth = np.pi * (3 - np.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    sphere = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], 1)
    return np.stack([r.apply(sphere) for r in Rotation.random(ROTATIONS, random_state=np.random.default_rng(0))]).astype(np.float32)


@lru_cache(maxsize=4)
def _cells(count: int, size: int) -> scipy.sparse.csr_matrix:
    """The matrix (ROTATIONS·count, 6·size²) that integrates a cube map over each direction's cell, in units of the mean cell 4π/count."""
    centre, angle = cubemap.directions(size).reshape(-1, 3), cubemap.solid_angles(size).ravel()
    column = np.arange(len(centre))
    rows = np.concatenate([rotation * count + cKDTree(copy).query(centre)[1] for rotation, copy in enumerate(directions(count))])
    weight = np.tile(angle * (count / (4 * np.pi)), ROTATIONS)
    return scipy.sparse.csr_matrix((weight.astype(np.float32), (rows, np.tile(column, ROTATIONS))), shape=(ROTATIONS * count, len(centre)))


@kernel("f4[:, ::1], i8[::1], f4[:, :, :], f4[:, ::1], f4[::1]", parallel=True, nogil=True, error_model="numpy")
def unoccluded_irradiance(normal: Any, rotation: Any, copies: Any, cells: Any, out: Any) -> None:
    """`out` (n,): irradiance / π of surfaces with unit `normal` (n, 3) under `cells` (ROTATIONS, count), each summed over the directions
    `copies` (ROTATIONS, count, 3) of its own `rotation` (n,)."""
    count = cells.shape[1]
    for i in prange(normal.shape[0]):
        r = rotation[i]
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        total = np.float32(0)
        for k in range(count):
            total += max(x * copies[r, k, 0] + y * copies[r, k, 1] + z * copies[r, k, 2], np.float32(0)) * cells[r, k]
        out[i] = total * np.float32(4 / count)


@dataclass(frozen=True)
class Visibility:
    """Blocked rays of the n texels.

    `blocked` (n, ROTATIONS·count) holds cos · Ω/π of blocked rays by direction, `hits` (n, n) the same by the texel they hit; `rotation`
    (n,) is each texel's copy of the `count` directions; `normal` (n, 3), `position` (n, 3) and `radius` (mesh units) control the filter.
    """

    texels: Texels
    position: Floats
    normal: Floats
    radius: float
    count: int
    rotation: NDArray[np.int64]
    blocked: scipy.sparse.csr_matrix
    hits: scipy.sparse.csr_matrix

    @classmethod
    def trace(
        cls,
        texels: Texels,
        uv: NDArray[Any],
        caster: RayCaster,
        normal: NDArray[Any],
        count: int,
        offset: float,
        radius: float,
        each: Callable[[int, int], None] | None = None,
    ) -> Visibility:
        """Trace `count` directions of the sphere from every texel.

        `caster` holds the mesh whose faces the texels refer to, `uv` (v, 2) its texture coordinates, origin top left; `normal` (n, 3)
        shading normals. Rays start `offset` above the surface; the filter averages texels within `radius` (both mesh units).
        `each(done, total)` is called after every round of one ray per texel.
        """
        corner = caster.vertices[caster.faces[texels.face]]
        geometric = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])).astype(np.float32)
        normal = unit(normal).astype(np.float32)
        position = texels.interpolate(caster.vertices, caster.faces)
        origin = position + offset * geometric
        column, row = texels.index % texels.size, texels.index // texels.size
        rotation = (row % PATTERN_SIZE) * PATTERN_SIZE + column % PATTERN_SIZE
        rounds: list[tuple[NDArray[Any], ...]] = []
        copies = directions(count)
        for k in range(count):
            ray = copies[rotation, k]
            cosine = np.einsum("nk,nk->n", normal, ray)
            # A ray above the shading normal's horizon but below the geometric one would start inside.
            above = np.flatnonzero((cosine > 0) & (np.einsum("nk,nk->n", geometric, ray) > 0))
            hits = caster.first_hit(origin[above], ray[above])
            hit = np.flatnonzero(hits.hit)
            texel = above[hit]
            target = texels.containing(np.einsum("nk,nkd->nd", hits.bary[hit], uv[caster.faces[hits.face[hit]]]))
            rounds.append((texel, rotation[texel] * count + k, target, cosine[texel] * (4 / count)))
            if each is not None:
                each(k + 1, count)
        texel, direction, target, weight = (np.concatenate(parts) for parts in zip(*rounds, strict=True))
        n, known = len(texels), target >= 0
        blocked = scipy.sparse.csr_matrix((weight, (texel, direction)), shape=(n, ROTATIONS * count))
        hit_texels = scipy.sparse.csr_matrix((weight[known], (texel[known], target[known])), shape=(n, n))
        return cls(texels, position, normal, radius, count, rotation, blocked, hit_texels)

    def visible_share(self, radiance: NDArray[Any]) -> Floats:
        """Unoccluded share (n,) of the irradiance by luminance, 0..1, under the cube map `radiance` (6, N, N, 3)."""
        cells = self._cell_radiance(radiance) @ LUMINANCE
        return self._filter(np.clip(1 - (self.blocked @ cells) / np.maximum(self._unoccluded_irradiance(cells), 1e-9), 0, 1))

    def indirect_irradiance(self, irradiance: NDArray[Any], reflectance: NDArray[Any]) -> Floats:
        """Indirect irradiance / π (n, 3) of texels with diffuse `reflectance` (n, 3) under direct `irradiance` / π (n, 3), after
        occlusion."""
        reflectance = np.asarray(reflectance, np.float32)
        indirect = np.zeros_like(reflectance)
        for _ in range(BOUNCES):
            indirect = self.hits @ (reflectance * (irradiance + indirect))
        return self._filter(indirect)

    def _cell_radiance(self, radiance: NDArray[Any]) -> Floats:
        """Radiance (ROTATIONS·count, 3) of each direction's cell."""
        return np.asarray(_cells(self.count, radiance.shape[1]) @ np.asarray(radiance, np.float32).reshape(-1, 3))

    def _unoccluded_irradiance(self, cells: Floats) -> Floats:
        """Irradiance / π (n,) of unoccluded texels under `cells` (ROTATIONS·count,), by the same quadrature as the blocked part."""
        out = np.empty(len(self.normal), np.float32)
        unoccluded_irradiance(self.normal, self.rotation, directions(self.count), cells.reshape(ROTATIONS, self.count), out)
        return out

    def _filter(self, value: Floats) -> Floats:
        """`value` (n,) or (n, c) averaged over neighbouring texels of the surface."""
        return smooth_over_surface(self.texels, value, self.position, self.normal, self.radius)
