"""What of the light the object keeps from itself, texel by texel, for any light: traced once, then linear in the light.

Every texel looks along the directions of one of `TURNS` turned copies of a Fibonacci sphere, spread over neighbouring texels in a fixed
pattern (interleaved sampling): one small filter afterwards sees all copies. Rays that meet the object are kept with their weight and the
texel they meet. A light is summed over the cells around the directions, so that even a small lamp counts fully in every texel; then

    kept(t) = Σ_blocked cos · Ω/π · L(cell),    openness = 1 − luminance(kept) / luminance(all),
    bounced(t) = Σ_blocked cos · Ω/π · reflectance(hit) · E(hit),

all as irradiance / π, two sparse products per light.

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
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.vectors import unit
from gsbake.shading import cubemap
from gsbake.texturing.ambient_occlusion import smoothed
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]

#: Copies of the directions along one edge of the pattern; the filter of `smoothed` is at least as wide.
PATTERN = 4
TURNS = PATTERN * PATTERN
#: Luminance of linear sRGB (ITU-R BT.709).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
#: Light that went from surface to surface this many times is followed.
BOUNCES = 2


@lru_cache(maxsize=4)
def directions(count: int) -> Floats:
    """Unit directions (TURNS, count, 3), each copy even over the whole sphere."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    sphere = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    return np.stack([r.apply(sphere) for r in Rotation.random(TURNS, random_state=np.random.default_rng(0))]).astype(np.float32)


@lru_cache(maxsize=4)
def _cells(count: int, size: int) -> scipy.sparse.csr_matrix:
    """The matrix (TURNS·count, 6·size²) that sums a cube map's radiance over each direction's cell, in units of an even cell (4π/count)."""
    centre, angle = cubemap.directions(size).reshape(-1, 3), cubemap.solid_angles(size).ravel()
    column = np.arange(len(centre))
    rows = np.concatenate([turn * count + cKDTree(copy).query(centre)[1] for turn, copy in enumerate(directions(count))])
    share = np.tile(angle * (count / (4 * np.pi)), TURNS)
    return scipy.sparse.csr_matrix((share.astype(np.float32), (rows, np.tile(column, TURNS))), shape=(TURNS * count, len(centre)))


@dataclass(frozen=True)
class Visibility:
    """Blocked rays of the n texels.

    `kept` (n, TURNS·count) holds cos · Ω/π of blocked rays at their direction, `met` (n, n) the same at the texel they meet; `turn` (n,)
    is each texel's copy of the `count` directions, `normal` (n, 3), `position` (n, 3) and `reach` (mesh units) steer the filter.
    """

    texels: Texels
    position: Floats
    normal: Floats
    reach: float
    count: int
    turn: NDArray[np.int64]
    kept: scipy.sparse.csr_matrix
    met: scipy.sparse.csr_matrix

    @classmethod
    def trace(
        cls,
        texels: Texels,
        uv: NDArray[Any],
        caster: RayCaster,
        normal: NDArray[Any],
        count: int,
        offset: float,
        reach: float,
        each: Callable[[int, int], None] | None = None,
    ) -> Visibility:
        """Trace `count` directions of the sphere from every texel.

        `caster` holds the mesh whose faces the texels name, `uv` (v, 2) its texture coordinates, origin top left; `normal` (n, 3) shading
        normals. Rays start `offset` above the surface; the filter averages texels within `reach` (both mesh units). `each(done, total)` is
        called after every round of one ray per texel.
        """
        corner = caster.vertices[caster.faces[texels.face]]
        facing = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])).astype(np.float32)
        normal = unit(normal).astype(np.float32)
        position = texels.interpolate(caster.vertices, caster.faces)
        origin = position + offset * facing
        column, row = texels.index % texels.size, texels.index // texels.size
        turn = (row % PATTERN) * PATTERN + column % PATTERN
        found: list[tuple[NDArray[Any], ...]] = []
        copies = directions(count)
        for k in range(count):
            ray = copies[turn, k]
            cosine = np.einsum("nk,nk->n", normal, ray)
            # A ray above the shading normal's horizon but below the mesh's own would start inside.
            up = np.flatnonzero((cosine > 0) & (np.einsum("nk,nk->n", facing, ray) > 0))
            hits = caster.first_hit(origin[up], ray[up])
            hit = np.flatnonzero(hits.hit)
            texel = up[hit]
            met = texels.holding(np.einsum("nk,nkd->nd", hits.bary[hit], uv[caster.faces[hits.face[hit]]]))
            found.append((texel, turn[texel] * count + k, met, cosine[texel] * (4 / count)))
            if each is not None:
                each(k + 1, count)
        texel, direction, met, weight = (np.concatenate(parts) for parts in zip(*found, strict=True))
        n, known = len(texels), met >= 0
        kept = scipy.sparse.csr_matrix((weight, (texel, direction)), shape=(n, TURNS * count))
        mets = scipy.sparse.csr_matrix((weight[known], (texel[known], met[known])), shape=(n, n))
        return cls(texels, position, normal, reach, count, turn, kept, mets)

    def openness(self, radiance: NDArray[Any]) -> Floats:
        """Share (n,) in 0..1 of the irradiance, by luminance, that the object lets through, under the cube map `radiance` (6, N, N, 3)."""
        cells = self._binned(radiance) @ LUMINANCE
        return self._filtered(np.clip(1 - (self.kept @ cells) / np.maximum(self._whole(cells), 1e-9), 0, 1))

    def bounced(self, irradiance: NDArray[Any], reflectance: NDArray[Any]) -> Floats:
        """Irradiance / π (n, 3) that texels get from each other when the light itself gives `irradiance` / π (n, 3), shadows included."""
        reflectance = np.asarray(reflectance, np.float32)
        gained = np.zeros_like(reflectance)
        for _ in range(BOUNCES):
            gained = self.met @ (reflectance * (irradiance + gained))
        return np.stack([self._filtered(gained[:, c]) for c in range(3)], 1)

    def _binned(self, radiance: NDArray[Any]) -> Floats:
        return np.asarray(_cells(self.count, radiance.shape[1]) @ np.asarray(radiance, np.float32).reshape(-1, 3))

    def _whole(self, cells: Floats) -> Floats:
        """Irradiance / π (n,) of texels in the open under the light of `cells` (TURNS·count,), by the same sum as what is kept."""
        out = np.zeros(len(self.normal), np.float32)
        for turn, copy in enumerate(directions(self.count)):
            mine = self.turn == turn
            out[mine] = np.maximum(self.normal[mine] @ copy.T, 0) @ cells[turn * self.count : (turn + 1) * self.count]
        return out * np.float32(4 / self.count)

    def _filtered(self, value: Floats) -> Floats:
        return smoothed(self.texels, value, self.position, self.normal, self.reach)
