"""The baked maps at any edge and for any level of detail.

Base colour, occlusion, roughness, metallic and emission belong to points of the texture and are only filtered. A normal map is in the frame
of one mesh: for a decimated one the baked normals are brought into the asset's frame, and coded again in the frames of its own triangles.
Cohen, Olano & Manocha, *Appearance-preserving simplification*, SIGGRAPH 1998.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.tangents import frame_to_world, world_to_frame
from gsbake.gltf.baked import read_texture
from gsbake.gltf.encode import Bytes, TextureMaps, quantise
from gsbake.gltf.write import GltfMesh
from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.texels import rasterise

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class BakedMaps:
    """Linear textures (s, s, 3) of the `mesh` that was baked: base colour, ORM, the coded normal map and emission, the last two or None.

    The base colour may be finer than the others.
    """

    mesh: GltfMesh
    base_color: Floats
    orm: Floats
    normal: Floats | None
    emissive: Floats | None

    @staticmethod
    def open(baked: Path, mesh: GltfMesh) -> BakedMaps:
        """Read the images of the artifact folder `baked`; `mesh` in the asset's frame."""
        normal, emissive = (read_texture(path) if path.exists() else None for path in (baked / "normal.exr", baked / "emissive.exr"))
        return BakedMaps(mesh, read_texture(baked / "base_color.exr"), read_texture(baked / "orm.exr"), normal, emissive)

    @property
    def edge(self) -> int:
        """Edge of the base colour in texels."""
        return len(self.base_color)

    @property
    def map_edge(self) -> int:
        """Edge of the other textures in texels."""
        return len(self.orm)


class MapSource:
    """The maps of one bake, filtered and recoded on demand; results are kept."""

    def __init__(self, maps: BakedMaps) -> None:
        self.maps = maps
        self.plain = cache(self._plain)
        self.world_normals = cache(self._world_normals)

    def at(self, mesh: GltfMesh, edge: int) -> TextureMaps:
        """The 8-bit maps for `mesh`, a decimated form of the baked one or itself, at an `edge` of at most the base colour's; other maps
        are no larger than they were baked."""
        plain = self.plain(edge)
        if mesh is self.maps.mesh:
            return plain
        return TextureMaps(plain.base_color, plain.orm, self._normal_map(mesh, edge), plain.emissive, plain.factors)

    def _plain(self, edge: int) -> TextureMaps:
        maps = self.maps
        normal = None if maps.normal is None else 0.5 + 0.5 * _unit(resized(2 * maps.normal - 1, edge))
        emissive = None if maps.emissive is None else resized(maps.emissive, edge)
        return quantise(resized(maps.base_color, edge), resized(maps.orm, edge), normal, emissive)

    def _world_normals(self, edge: int) -> Floats:
        """Unit normals (edge, edge, 3), at most as many as baked, in the asset's frame, continued beyond the charts as seams move."""
        mesh, full = self.maps.mesh, self.maps.map_edge
        texels = rasterise(mesh.uv, mesh.faces, full)
        normal = texels.interpolate(mesh.normal, mesh.faces)
        if self.maps.normal is None:
            world = _unit(normal)
        else:
            coded = self.maps.normal.reshape(-1, 3)[texels.index]
            world = frame_to_world(2 * coded - 1, normal, texels.interpolate(mesh.tangent, mesh.faces)).astype(np.float32)
        image = fill_empty_texels(texels.image(world), texels.covered(), gutter=max(2, full // 64))
        return _unit(resized(image, edge))

    def _normal_map(self, mesh: GltfMesh, edge: int) -> Bytes:
        """8-bit normal map of a decimated mesh."""
        edge = min(edge, self.maps.map_edge)
        texels = rasterise(mesh.uv, mesh.faces, edge)
        normal, tangent = (texels.interpolate(values, mesh.faces) for values in (mesh.normal, mesh.tangent))
        local = world_to_frame(self.world_normals(edge).reshape(-1, 3)[texels.index], normal, tangent)
        usable = np.isfinite(local).all(1) & (local[:, 2] > 0.05)
        local[~usable] = (0.0, 0.0, 1.0)
        image = fill_empty_texels(texels.image(0.5 + 0.5 * local), texels.covered(), gutter=max(2, edge // 256))
        return np.asarray(np.floor(np.clip(image, 0, 1) * 255 + 0.5), np.uint8)


def resized(image: NDArray[Any], edge: int) -> Floats:
    """A square image filtered to a smaller `edge`, by area; unchanged where it is no larger."""
    if image.shape[0] <= edge:
        return np.asarray(image, np.float32)
    return np.asarray(cv2.resize(np.asarray(image, np.float32), (edge, edge), interpolation=cv2.INTER_AREA), np.float32)


def _unit(image: NDArray[Any]) -> Floats:
    return np.asarray(image / np.maximum(np.linalg.norm(image, axis=-1, keepdims=True), 1e-6), np.float32)
