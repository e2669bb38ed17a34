"""The light mesh cut into charts, with all that the textures are made from: frames, texels, and rays against it."""

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
class Surface:
    """The light mesh cut into charts.

    Per atlas vertex `position` (v, 3), `normal` (v, 3), `tangent` (v, 4); its texels, their points `at` (n, 3) and unit normals `facing`
    (n, 3); `caster` holds the mesh before it was cut, `whole` the cut one with the atlas'
    triangles; `diagonal` of the bounding box and `texel` edge in the unit frame.
    """

    atlas: Atlas
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    tangent: NDArray[np.float32]
    texels: Texels
    at: NDArray[np.float32]
    facing: NDArray[np.float32]
    caster: RayCaster
    whole: RayCaster
    diagonal: float
    texel: float

    @classmethod
    def of(cls, vertices: NDArray[Any], faces: NDArray[Any], atlas: Atlas, size: int, threads: int) -> Surface:
        """The mesh of `vertices` (v, 3) and `faces` (f, 3) cut as `atlas` says, on a square texture of `size`."""
        position, normal = vertices[atlas.source], vertex_normals(vertices, faces)[atlas.source]
        frames = tangents(position, normal, atlas.uv, atlas.faces)
        atlas = replace(atlas, source=atlas.source[frames.source], uv=atlas.uv[frames.source], faces=frames.faces)
        position, normal = position[frames.source], normal[frames.source]
        texels = rasterise(atlas.uv, atlas.faces, size)
        facing = texels.interpolate(normal, atlas.faces)
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
        corner = vertices[faces]
        area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
        return cls(
            atlas, position, normal, frames.tangent, texels, texels.interpolate(position, atlas.faces), facing,
            RayCaster(vertices, faces, threads), RayCaster(position, atlas.faces, threads),
            float(np.linalg.norm(np.ptp(vertices, axis=0))), float(np.sqrt(area / (atlas.fill * size * size))),
        )  # fmt: skip
