"""The unwrapped low-poly mesh: tangent frames, texels, and ray casters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.tangents import tangents
from gsbake.texturing.atlas import Atlas
from gsbake.texturing.normal_map import vertex_normals
from gsbake.texturing.texels import Texels, rasterise


@dataclass(frozen=True)
class UnwrappedMesh:
    """The low-poly mesh unwrapped into charts.

    Per atlas vertex `position` (v, 3), `normal` (v, 3), `tangent` (v, 4); the `texels`, their `texel_position` (n, 3) and unit
    `texel_normal` (n, 3); `caster` holds the mesh before unwrapping, `atlas_caster` the unwrapped one; `diagonal` of the bounding box and
    mean edge `texel_size` of a texel, both in the unit frame.
    """

    atlas: Atlas
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    tangent: NDArray[np.float32]
    texels: Texels
    texel_position: NDArray[np.float32]
    texel_normal: NDArray[np.float32]
    caster: RayCaster
    atlas_caster: RayCaster
    diagonal: float
    texel_size: float

    @classmethod
    def of(cls, vertices: NDArray[Any], faces: NDArray[Any], atlas: Atlas, size: int, threads: int) -> UnwrappedMesh:
        """The mesh of `vertices` (v, 3) and `faces` (f, 3) unwrapped by `atlas`, on a square texture of `size`."""
        position, normal = vertices[atlas.source], vertex_normals(vertices, faces)[atlas.source]
        frames = tangents(position, normal, atlas.uv, atlas.faces)
        atlas = replace(atlas, source=atlas.source[frames.source], uv=atlas.uv[frames.source], faces=frames.faces)
        position, normal = position[frames.source], normal[frames.source]
        texels = rasterise(atlas.uv, atlas.faces, size)
        texel_normal = texels.interpolate(normal, atlas.faces)
        texel_normal /= np.maximum(np.linalg.norm(texel_normal, axis=1, keepdims=True), 1e-12)
        corner = vertices[faces]
        area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
        return cls(
            atlas, position, normal, frames.tangent, texels, texels.interpolate(position, atlas.faces), texel_normal,
            RayCaster(vertices, faces, threads), RayCaster(position, atlas.faces, threads),
            float(np.linalg.norm(np.ptp(vertices, axis=0))), float(np.sqrt(area / (atlas.fill * size * size))),
        )  # fmt: skip
