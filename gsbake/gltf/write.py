"""Writer of the asset's GLB: one mesh, one material, up to four textures; on request levels of detail, compression and quantisation.

Other libraries such as trimesh do not write TANGENT. The bytes depend only on the input, so assets are comparable by digest.

glTF 2.0 specification, sections 3.6 (buffers, accessors), 3.7 (meshes), 3.9 (materials); EXT_texture_webp, KHR_texture_basisu,
KHR_mesh_quantization, EXT_meshopt_compression, MSFT_lod.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsbake.gltf.buffer import MESHOPT, Buffer
from gsbake.gltf.container import pack_glb
from gsbake.gltf.quantise import QUANTIZATION, Placement, signed, unsigned, with_area
from gsbake.imaging.encoded import image_format

LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP = 9729, 9987, 33071
WEBP, BASISU, LOD = "EXT_texture_webp", "KHR_texture_basisu", "MSFT_lod"
#: {image format: (media type, extension of its texture)}.
IMAGE_KINDS = {"png": ("image/png", None), "jpeg": ("image/jpeg", None), "webp": ("image/webp", WEBP), "ktx2": ("image/ktx2", BASISU)}
Geometry = Literal["float", "quantised", "meshopt"]


@dataclass(frozen=True)
class GltfMesh:
    """Triangles in the glTF frame (+Y up).

    `position` (v, 3), unit `normal` (v, 3), `tangent` (v, 4), `uv` (v, 2) with the origin at the top left, `faces` (f, 3).
    """

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    tangent: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]


@dataclass(frozen=True)
class GltfTextures:
    """Encoded images, PNG, JPEG, WebP or KTX2: base colour (sRGB), occlusion-roughness-metallic (ORM) and normal map (both linear),
    emissive (sRGB); the last two may be absent. With constant roughness and metallic, `orm` is occlusion only."""

    base_color: bytes
    orm: bytes
    normal: bytes | None
    emissive: bytes | None = None


@dataclass(frozen=True)
class Level:
    """A coarser level of detail: its mesh and textures, and the share of the screen's height from which on it is shown."""

    mesh: GltfMesh
    textures: GltfTextures
    coverage: float


def build_glb(
    mesh: GltfMesh,
    textures: GltfTextures,
    name: str,
    generator: str,
    copyright_line: str = "",
    extras: dict[str, Any] | None = None,
    factors: tuple[float, float] | None = None,
    *,
    geometry: Geometry = "float",
    levels: Sequence[Level] = (),
    coverage: float = 1.0,
) -> bytes:
    """The bytes of the asset. Raises ValueError when the mesh is empty or its arrays differ in length.

    `factors` are constant roughness and metallic; `textures.orm` is then occlusion only. `levels` are coarser ones for MSFT_lod, the finest
    first; `coverage` is the share of the screen's height from which on the mesh itself is shown.
    """
    for each in (mesh, *(level.mesh for level in levels)):
        if len(each.faces) == 0 or not (len(each.normal) == len(each.tangent) == len(each.uv) == len(each.position)):
            raise ValueError("the mesh is empty or its attributes differ in length")
    return _Writer(name, factors, geometry).document(mesh, textures, levels, coverage, generator, copyright_line, extras)


class _Writer:
    """Collects buffer, images, materials and meshes of one file; equal images are stored once."""

    def __init__(self, name: str, factors: tuple[float, float] | None, geometry: Geometry) -> None:
        self.name, self.factors, self.geometry = name, factors, geometry
        self.buffer = Buffer(compressed=geometry == "meshopt")
        self.images: list[dict[str, Any]] = []
        self.textures: list[dict[str, Any]] = []
        self.materials: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []
        self.extensions: set[str] = {QUANTIZATION} if geometry != "float" else set()
        self._known: dict[bytes, int] = {}
        if geometry == "meshopt":
            self.extensions.add(MESHOPT)

    def document(
        self, mesh: GltfMesh, textures: GltfTextures, levels: Sequence[Level], coverage: float, generator: str, copyright_line: str,
        extras: dict[str, Any] | None,
    ) -> bytes:  # fmt: skip
        """The bytes of the GLB."""
        place = None if self.geometry == "float" else Placement.of(mesh.position, *(level.mesh.position for level in levels))
        for index, (body, images) in enumerate([(mesh, textures), *((level.mesh, level.textures) for level in levels)]):
            primitive = self._primitive(body, place)
            self.meshes.append({"name": f"{self.name}_lod{index}" if index else self.name, "primitives": [primitive]})
            material = self._material(images)
            if material not in self.materials:
                self.materials.append(material)
            primitive["material"] = self.materials.index(material)
        nodes: list[dict[str, Any]] = [
            {"name": entry["name"], "mesh": index, **({} if place is None else place.node())} for index, entry in enumerate(self.meshes)
        ]
        used, required = set(self.extensions), set(self.extensions)
        if levels:
            nodes[0]["extensions"] = {LOD: {"ids": list(range(1, len(nodes)))}}
            nodes[0]["extras"] = {"MSFT_screencoverage": [coverage, *(level.coverage for level in levels)]}
            used.add(LOD)
        asset: dict[str, Any] = {"version": "2.0", "generator": generator}
        if copyright_line:
            asset["copyright"] = copyright_line
        if extras:
            asset["extras"] = extras
        document = {
            "asset": asset,
            **({"extensionsUsed": sorted(used)} if used else {}),
            **({"extensionsRequired": sorted(required)} if required else {}),
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": self.meshes,
            "materials": self.materials,
            "textures": self.textures,
            "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
            "images": self.images,
            "accessors": self.buffer.accessors,
            "bufferViews": self.buffer.views,
            "buffers": self.buffer.entries(),
        }
        return pack_glb(document, bytes(self.buffer.data))

    def _primitive(self, mesh: GltfMesh, place: Placement | None) -> dict[str, Any]:
        """Append a mesh to the buffer; returns its primitive without material."""
        faces: NDArray[Any] = mesh.faces
        if place is None:
            values: dict[str, NDArray[Any]] = {
                "POSITION": np.ascontiguousarray(mesh.position, "<f4"), "NORMAL": np.ascontiguousarray(mesh.normal, "<f4"),
                "TANGENT": np.ascontiguousarray(mesh.tangent, "<f4"), "TEXCOORD_0": np.ascontiguousarray(mesh.uv, "<f4"),
            }  # fmt: skip
        else:
            position = place.fractions(mesh.position)
            faces = with_area(position, faces)
            values = {"POSITION": position, "NORMAL": signed(mesh.normal), "TANGENT": signed(mesh.tangent), "TEXCOORD_0": unsigned(mesh.uv)}
        if self.buffer.compressed:
            values, faces = _in_order_of_use(values, faces)
        attributes = {key: self.buffer.attribute(rows, bounds=key == "POSITION") for key, rows in values.items()}
        return {"attributes": attributes, "indices": self.buffer.indices(faces, len(values["POSITION"])), "material": 0, "mode": 4}

    def _material(self, textures: GltfTextures) -> dict[str, Any]:
        """Append the textures to the buffer; returns the material."""
        packed = "orm" if self.factors is None else "occlusion"
        surface: dict[str, Any] = {"baseColorTexture": {"index": self._texture("base_color", textures.base_color)}}
        orm = {"index": self._texture(packed, textures.orm)}
        if self.factors is None:
            surface["metallicRoughnessTexture"] = orm
        else:
            surface["roughnessFactor"], surface["metallicFactor"] = self.factors
        material: dict[str, Any] = {
            "name": self.name,
            "pbrMetallicRoughness": surface,
            "occlusionTexture": dict(orm),
            "alphaMode": "OPAQUE",
        }
        for role, content in (("normal", textures.normal), ("emissive", textures.emissive)):
            if content is not None:
                material[f"{role}Texture"] = {"index": self._texture(role, content)}
        if textures.emissive is not None:
            material["emissiveFactor"] = [1, 1, 1]
        return material

    def _texture(self, role: str, content: bytes) -> int:
        """Index of the texture of an image, which is appended unless the file has it."""
        if content not in self._known:
            media, extension = IMAGE_KINDS[image_format(content)]
            self.images.append({"name": role, "mimeType": media, "bufferView": self.buffer.view(content)})
            source = {"source": len(self.images) - 1}
            if extension is None:
                self.textures.append({"sampler": 0, **source})
            else:
                self.textures.append({"sampler": 0, "extensions": {extension: source}})
                self.extensions.add(extension)
            self._known[content] = len(self.textures) - 1
        return self._known[content]


def _in_order_of_use(values: dict[str, NDArray[Any]], faces: NDArray[Any]) -> tuple[dict[str, NDArray[Any]], NDArray[Any]]:
    """Vertices and triangles in the order that meshoptimizer's codecs compress best; unused vertices are dropped."""
    import meshopt

    corners, remap, unique = meshopt.reorder_mesh(np.ascontiguousarray(faces, np.uint32).ravel(), triangles=True, optsize=True)
    order = np.argsort(remap.astype(np.int64), kind="stable")[:unique]
    return {key: rows[order] for key, rows in values.items()}, corners.reshape(-1, 3)
