"""The triangles and materials of any glTF file, placed in the world: what the renderer, `inspect` and `compare` work on.

Nodes' transforms are applied; skins and morph targets are left at rest. Missing normals are flat, missing tangents are MikkTSpace's.
glTF 2.0 specification, sections 3.5 (nodes), 3.7 (meshes), 3.9 (materials); KHR_texture_transform; KHR_materials_unlit;
KHR_materials_emissive_strength.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.geometry.mesh_process import MAX_COORDINATE
from gsbake.geometry.tangents import tangents
from gsbake.geometry.vectors import unit
from gsbake.gltf.document import Document, texture_infos, texture_source

TRIANGLES, STRIP, FAN = 4, 5, 6
#: Numbers in a row of the attributes that are read; there may be several of TEXCOORD_.
WIDTHS = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (4,), "TEXCOORD_": (2,), "COLOR_0": (3, 4)}
#: Deepest chain of nodes.
MAX_DEPTH = 256
#: Most triangles and most parts after instancing.
MAX_TRIANGLES, MAX_PARTS = 50_000_000, 100_000
#: Bytes that a vertex, a triangle and a part take in a scene and what is made of it: its arrays twice, ray tracing, sampled surfaces.
VERTEX_BYTES, TRIANGLE_BYTES, PART_BYTES = 200, 350, 4000
#: UV sets that the bytes of a vertex include, and bytes of each further one.
USUAL_UV_SETS, UV_SET_BYTES = 2, 24
#: Largest texture coordinate and factor of a material: beyond, single precision overflows.
MAX_UV, MAX_FACTOR = 1e6, 1e9


@dataclass(frozen=True)
class TextureUse:
    """A texture in a material: `image` index, UV set `uv`, matrix `transform` (2, 3) on (u, v, 1), wrap modes (OpenGL constants)."""

    image: int
    uv: int
    transform: NDArray[np.float64]
    wrap: tuple[int, int]

    def coordinates(self, uv: NDArray[np.float32]) -> NDArray[np.float32]:
        """The transformed texture coordinates (n, 2)."""
        return np.asarray(uv.astype(np.float64) @ self.transform[:, :2].T + self.transform[:, 2], np.float32)


@dataclass(frozen=True)
class Material:
    """Metallic-roughness material: factors, `textures` by role ("base_color", "orm", "occlusion", "normal", "emissive"), transparency."""

    name: str = ""
    base_color: tuple[float, ...] = (1, 1, 1, 1)
    roughness: float = 1.0
    metallic: float = 1.0
    emissive: tuple[float, ...] = (0, 0, 0)
    normal_scale: float = 1.0
    occlusion_strength: float = 1.0
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False
    textures: dict[str, TextureUse] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Part:
    """One primitive in the world: `position` (v, 3), unit `normal` (v, 3), `tangent` (v, 4) or None, UV sets `uv` {index: (v, 2)} with
    the origin top left, `colour` (v, 4) linear or None, `faces` (f, 3), index of its `material`."""

    name: str
    position: NDArray[np.float64]
    normal: NDArray[np.float32]
    tangent: NDArray[np.float32] | None
    uv: dict[int, NDArray[np.float32]]
    colour: NDArray[np.float32] | None
    faces: NDArray[np.int32]
    material: int


@dataclass(frozen=True, eq=False)
class Scene:
    """All parts, materials and notes on what was left out of the file; `document` holds the images."""

    parts: tuple[Part, ...]
    materials: tuple[Material, ...]
    document: Document
    notes: tuple[str, ...]

    @property
    def vertices(self) -> NDArray[np.float64]:
        """Positions (v, 3) of all parts."""
        return np.concatenate([p.position for p in self.parts])

    @property
    def faces(self) -> NDArray[np.int32]:
        """Triangles (f, 3) of all parts, as indices of `vertices`."""
        start = np.cumsum([0, *(len(p.position) for p in self.parts)])
        return np.concatenate([p.faces + s for p, s in zip(self.parts, start, strict=False)]).astype(np.int32)

    @property
    def normals(self) -> NDArray[np.float32]:
        """Unit normals (v, 3) of `vertices`."""
        return np.concatenate([p.normal for p in self.parts])


def open_scene(path: Path) -> Scene:
    """Read a .glb or .gltf file. Raises BadInputError."""
    return read_scene(Document.open(path))


def read_scene(document: Document) -> Scene:
    """The scene of a parsed document. Raises BadInputError where it is malformed or holds no triangles."""
    with document.readable(), np.errstate(all="ignore"):
        materials = [*(_material(document, m) for m in document.json.get("materials", [])), Material("default")]
        notes = [f"{name} is left out" for name in document.ignored]
        if document.json.get("skins") or any("targets" in p for m in document.json.get("meshes", []) for p in m["primitives"]):
            notes.append("skins and morph targets are at rest")
        instances = _instances(document)
        triangles = _count(document, [mesh for mesh, _ in instances])
        parts: list[Part] = []
        for mesh, matrix in instances:
            entry = document.entry("meshes", mesh)
            for primitive in entry["primitives"]:
                if primitive.get("mode", TRIANGLES) < TRIANGLES:
                    notes.append("points and lines are left out")
                    continue
                parts.append(_part(document, str(entry.get("name", f"mesh {mesh}")), primitive, matrix, materials))
        parts = [part for part in parts if len(part.faces)]
        if not triangles or not parts:
            raise BadInputError(f"'{document.name}' holds no triangles.")
    return Scene(tuple(parts), tuple(materials), document, tuple(dict.fromkeys(notes)))


def _count(document: Document, meshes: list[int]) -> int:
    """Triangles of the meshes, each as often as it is placed, from the counts in the document; their memory is spent.

    Raises BadInputError where they are too many, or need more memory than there is.
    """
    triangles = parts = needed = 0
    for mesh, placed in Counter(meshes).items():
        for primitive in document.entry("meshes", mesh)["primitives"]:
            mode = primitive.get("mode", TRIANGLES)
            if mode < TRIANGLES:
                continue
            vertices = document.count(primitive["attributes"]["POSITION"])
            corners = document.count(primitive["indices"]) if "indices" in primitive else vertices
            faces = corners // 3 if mode == TRIANGLES else max(0, corners - 2)
            triangles, parts = triangles + placed * faces, parts + placed
            sets = sum(key.startswith("TEXCOORD_") for key in primitive["attributes"])
            vertex = VERTEX_BYTES + UV_SET_BYTES * max(0, sets - USUAL_UV_SETS)
            needed += placed * (PART_BYTES + max(vertices, 3 * faces) * vertex + faces * TRIANGLE_BYTES)
    if triangles > MAX_TRIANGLES:
        raise BadInputError(f"'{document.name}' has {triangles} triangles, more than {MAX_TRIANGLES}; simplify it first.")
    if parts > MAX_PARTS:
        raise BadInputError(f"'{document.name}' has {parts} parts, more than {MAX_PARTS}; join them first.")
    document.spend(needed)
    return triangles


def _instances(document: Document) -> list[tuple[int, NDArray[np.float64]]]:
    """(mesh, world matrix (4, 4)) of every node with a mesh in the default scene; of every mesh where there are no scenes."""
    if not document.json.get("scenes", []):
        return [(k, np.eye(4)) for k in range(len(document.json.get("meshes", [])))]
    scene = document.entry("scenes", document.json.get("scene", 0))
    found: list[tuple[int, NDArray[np.float64]]] = []
    stack = [(n, np.eye(4), 0) for n in reversed(scene.get("nodes", []))]
    visited: set[int] = set()
    while stack:
        index, outer, depth = stack.pop()
        node = document.entry("nodes", index)
        if index in visited or depth > MAX_DEPTH:
            raise ValueError("its nodes are no tree")
        visited.add(index)
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise BadInputError(f"'{document.name}' has instances (EXT_mesh_gpu_instancing), which gsbake does not read.")
        matrix = outer @ _local(node)
        if "mesh" in node:
            found.append((node["mesh"], matrix))
        stack += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]
    return found


def _local(node: dict[str, Any]) -> NDArray[np.float64]:
    """Matrix (4, 4) of a node: `matrix`, or translation · rotation · scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = (float(q) for q in node.get("rotation", (0, 0, 0, 1)))
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    out = np.eye(4)
    out[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    out[:3, 3] = node.get("translation", (0, 0, 0))
    return out


def _part(document: Document, name: str, primitive: dict[str, Any], matrix: NDArray[np.float64], materials: list[Material]) -> Part:
    if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
        raise BadInputError(f"'{document.name}' needs KHR_draco_mesh_compression, which gsbake does not read; export it without.")
    stated = primitive["attributes"]
    if len({document.count(index) for index in stated.values()}) != 1:
        raise ValueError(f"the attributes of {name} differ in number")
    attributes = {key: _attribute(document, key, index) for key, index in stated.items() if _width_name(key) is not None}
    position = attributes["POSITION"].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    count = len(position)
    if not (np.abs(position) <= MAX_COORDINATE).all():
        raise ValueError(f"the vertices of {name} are not finite, or beyond {MAX_COORDINATE:g}")
    corners = document.accessor(primitive["indices"]) if "indices" in primitive else np.arange(count)
    if corners.ndim != 1 or corners.dtype.kind not in "ui":
        raise ValueError(f"the indices of {name} are no integers")
    corners = corners.astype(np.int64)
    faces = _triangles(corners, primitive.get("mode", TRIANGLES))
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise ValueError(f"{name} has corners that are no vertices")
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    uv = {int(k[9:]): v.astype(np.float32) for k, v in attributes.items() if k.startswith("TEXCOORD_")}
    if not all((np.abs(v) <= MAX_UV).all() for v in uv.values()):
        raise ValueError(f"the texture coordinates of {name} are not finite, or beyond {MAX_UV:g}")
    colour = attributes.get("COLOR_0")
    if colour is not None:
        colour = np.nan_to_num(colour.astype(np.float32), posinf=MAX_FACTOR, neginf=0).clip(0, MAX_FACTOR)
        colour = np.concatenate([colour, np.ones((count, 1), np.float32)], 1) if colour.shape[1] == 3 else colour
    material = primitive.get("material", len(materials) - 1)
    if "material" in primitive:
        document.entry("materials", material)
    part = Part(name, position, np.zeros((count, 3), np.float32), None, uv, colour, np.ascontiguousarray(faces, np.int32), material)
    if "NORMAL" in attributes:
        inverse = np.linalg.pinv(matrix[:3, :3])
        normal = np.nan_to_num(attributes["NORMAL"].astype(np.float64) @ inverse)
        part = replace(part, normal=unit(normal).astype(np.float32))
    else:
        part = _flat(part)
    if "TANGENT" in attributes and "NORMAL" in attributes:
        tangent = attributes["TANGENT"].astype(np.float64)
        direction = unit(np.nan_to_num(tangent[:, :3] @ matrix[:3, :3].T))
        handedness = np.where(tangent[:, 3:] < 0, -1.0, 1.0) * np.sign(np.linalg.det(matrix[:3, :3]) or 1)
        return replace(part, tangent=np.concatenate([direction, handedness], 1).astype(np.float32))
    normal_map = materials[material].textures.get("normal")
    if normal_map is None or normal_map.uv not in uv or not len(faces):
        return part
    frames = tangents(part.position, part.normal, uv[normal_map.uv], part.faces)
    return replace(_rows(part, frames.source), tangent=frames.tangent, faces=frames.faces)


def _width_name(key: str) -> str | None:
    """The entry of `WIDTHS` for a vertex attribute; None of those that are not read."""
    name = "TEXCOORD_" if key.startswith("TEXCOORD_") else key
    return name if name in WIDTHS else None


def _attribute(document: Document, key: str, index: int) -> NDArray[Any]:
    """Values of a vertex attribute. Raises ValueError unless it has a width that the specification gives it."""
    values = document.accessor(index)
    widths = WIDTHS[_width_name(key) or key]
    if values.ndim != 2 or values.shape[1] not in widths:
        raise ValueError(f"{key} has rows of the shape {values.shape[1:]}")
    return values


def _rows(part: Part, source: NDArray[Any]) -> Part:
    """The part with its vertices taken from `source` (v',)."""
    uv = {k: v[source] for k, v in part.uv.items()}
    colour = None if part.colour is None else part.colour[source]
    return replace(part, position=part.position[source], normal=part.normal[source], uv=uv, colour=colour)


def _flat(part: Part) -> Part:
    """The part with three vertices and one normal a triangle, as glTF asks where normals are missing."""
    source = part.faces.ravel()
    corner = part.position[part.faces]
    normal = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    out = _rows(part, source)
    return replace(out, normal=np.repeat(normal, 3, 0).astype(np.float32), faces=np.arange(len(source), dtype=np.int32).reshape(-1, 3))


def _triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Triangles (f, 3) of a list, a strip or a fan of corners."""
    if mode == TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode not in (STRIP, FAN):
        raise ValueError(f"the primitive mode {mode} does not exist")
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == FAN:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], 1)
    out = np.stack([corners[:-2], corners[1:-1], corners[2:]], 1)
    out[1::2] = out[1::2, [1, 0, 2]]
    return out


def _material(document: Document, entry: dict[str, Any]) -> Material:
    surface = entry.get("pbrMetallicRoughness", {})
    extensions = entry.get("extensions", {})
    found = {role: _use(document, info) for role, info in texture_infos(entry).items()}
    strength = _number(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    return Material(
        name=str(entry.get("name", "")),
        base_color=_numbers(surface.get("baseColorFactor", (1, 1, 1, 1)), 4),
        roughness=_number(surface.get("roughnessFactor", 1.0)),
        metallic=_number(surface.get("metallicFactor", 1.0)),
        emissive=tuple(strength * x for x in _numbers(entry.get("emissiveFactor", (0, 0, 0)), 3)),
        normal_scale=_number((entry.get("normalTexture") or {}).get("scale", 1.0)),
        occlusion_strength=_number((entry.get("occlusionTexture") or {}).get("strength", 1.0)),
        alpha_mode=str(entry.get("alphaMode", "OPAQUE")),
        alpha_cutoff=_number(entry.get("alphaCutoff", 0.5)),
        double_sided=bool(entry.get("doubleSided", False)),
        unlit="KHR_materials_unlit" in extensions,
        textures={role: use for role, use in found.items() if use is not None},
    )


def _use(document: Document, info: dict[str, Any]) -> TextureUse | None:
    """Use of a texture, or None where it has no image."""
    image = texture_source(document.json, info["index"])
    if image is None:
        return None
    document.entry("images", image)
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    (sx, sy), (ox, oy), angle = (
        _numbers(moved.get("scale", (1, 1)), 2),
        _numbers(moved.get("offset", (0, 0)), 2),
        _number(moved.get("rotation", 0)),
    )
    c, s = math.cos(angle), math.sin(angle)
    # translation · rotation · scale; the rotation is counter-clockwise in the image, whose v points down
    transform = np.array([[c * sx, s * sy, ox], [-s * sx, c * sy, oy]])
    texture = document.entry("textures", info["index"])
    sampler = document.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
    uv = moved.get("texCoord", info.get("texCoord", 0))
    return TextureUse(image, int(uv), transform, (sampler.get("wrapS", 10497), sampler.get("wrapT", 10497)))


def _numbers(values: Any, count: int) -> tuple[float, ...]:
    """`count` numbers. Raises ValueError."""
    out = tuple(_number(v) for v in values)
    if len(out) != count:
        raise ValueError(f"{len(out)} numbers instead of {count}")
    return out


def _number(value: Any) -> float:
    """A number of at most `MAX_FACTOR`. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_FACTOR:
        raise ValueError(f"{str(value)[:50]!r} is no number of at most {MAX_FACTOR:g}")
    return float(value)
