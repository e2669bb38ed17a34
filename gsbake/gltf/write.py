"""Writer of the asset's GLB: one mesh, one material, up to four textures.

Other libraries such as trimesh do not write TANGENT. The bytes depend only on the input, so assets are comparable by digest.

glTF 2.0 specification, sections 3.6 (buffers, accessors), 3.7 (meshes), 3.9 (materials).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.gltf.container import pack_glb

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP = 9729, 9987, 33071


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
    """Encoded PNG files: base colour (sRGB), occlusion-roughness-metallic (ORM) and normal map (both linear), emissive (sRGB); the last
    two may be absent. With constant roughness and metallic, `orm` is occlusion only."""

    base_color: bytes
    orm: bytes
    normal: bytes | None
    emissive: bytes | None = None


@dataclass
class _Buffer:
    """Builder of the binary chunk with its buffer views and accessors."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes at a multiple of four; returns the index of their buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        if target is not None:
            entry["target"] = target
        self.data += content
        self.views.append(entry)
        return len(self.views) - 1

    def accessor(self, values: NDArray[Any], kind: str, component: int, target: int, bounds: bool = False) -> int:
        """Append an array as an accessor with its own buffer view; returns its index."""
        entry: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
            "componentType": component,
            "count": int(values.size if kind == "SCALAR" else len(values)),
            "type": kind,
        }
        if bounds:
            columns = values.reshape(len(values), -1)
            entry |= {"min": [x.item() for x in columns.min(0)], "max": [x.item() for x in columns.max(0)]}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def build_glb(
    mesh: GltfMesh,
    textures: GltfTextures,
    name: str,
    generator: str,
    copyright_line: str = "",
    extras: dict[str, Any] | None = None,
    factors: tuple[float, float] | None = None,
) -> bytes:
    """The bytes of the asset. Raises ValueError when the mesh is empty or its arrays differ in length.

    `factors` are constant roughness and metallic; `textures.orm` is then occlusion only.
    """
    count = len(mesh.position)
    if len(mesh.faces) == 0 or not (len(mesh.normal) == len(mesh.tangent) == len(mesh.uv) == count):
        raise ValueError("the mesh is empty or its attributes differ in length")
    buffer = _Buffer()
    primitive = _primitive(mesh, buffer)
    material, images = _material(textures, name, factors, buffer)
    asset: dict[str, Any] = {"version": "2.0", "generator": generator}
    if copyright_line:
        asset["copyright"] = copyright_line
    if extras:
        asset["extras"] = extras
    document = {
        "asset": asset,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [material],
        "textures": [{"sampler": 0, "source": k} for k in range(len(images))],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
        "images": images,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data) + -len(buffer.data) % 4}],
    }
    return pack_glb(document, bytes(buffer.data))


def _primitive(mesh: GltfMesh, buffer: _Buffer) -> dict[str, Any]:
    """Append the mesh to the buffer; returns its primitive."""
    attributes = {
        "POSITION": buffer.accessor(np.ascontiguousarray(mesh.position, "<f4"), "VEC3", FLOAT, ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.accessor(np.ascontiguousarray(mesh.normal, "<f4"), "VEC3", FLOAT, ARRAY_BUFFER),
        "TANGENT": buffer.accessor(np.ascontiguousarray(mesh.tangent, "<f4"), "VEC4", FLOAT, ARRAY_BUFFER),
        "TEXCOORD_0": buffer.accessor(np.ascontiguousarray(mesh.uv, "<f4"), "VEC2", FLOAT, ARRAY_BUFFER),
    }
    # 65535 is the primitive-restart value of 16-bit indices and may not be used.
    component, width = (UNSIGNED_SHORT, "<u2") if len(mesh.position) < 65535 else (UNSIGNED_INT, "<u4")
    indices = buffer.accessor(np.ascontiguousarray(mesh.faces, width).ravel(), "SCALAR", component, ELEMENT_ARRAY_BUFFER)
    return {"attributes": attributes, "indices": indices, "material": 0, "mode": 4}


def _material(
    textures: GltfTextures, name: str, factors: tuple[float, float] | None, buffer: _Buffer
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Append the textures to the buffer; returns the material and the images, where texture k reads image k."""
    surface: dict[str, Any] = {"baseColorTexture": {"index": 0}}
    if factors is None:
        surface["metallicRoughnessTexture"] = {"index": 1}
    else:
        surface["roughnessFactor"], surface["metallicFactor"] = factors
    material: dict[str, Any] = {
        "name": name,
        "pbrMetallicRoughness": surface,
        "occlusionTexture": {"index": 1},
        "alphaMode": "OPAQUE",
    }
    packed = "orm" if factors is None else "occlusion"
    contents = {"base_color": textures.base_color, packed: textures.orm, "normal": textures.normal, "emissive": textures.emissive}
    images: list[dict[str, Any]] = []
    for role, content in contents.items():
        if content is not None:
            images.append({"name": role, "mimeType": "image/png", "bufferView": buffer.view(content)})
            if role in ("normal", "emissive"):
                material[f"{role}Texture"] = {"index": len(images) - 1}
    if textures.emissive is not None:
        material["emissiveFactor"] = [1, 1, 1]
    return material, images
