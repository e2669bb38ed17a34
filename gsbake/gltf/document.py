"""Any glTF file, GLB or JSON with files beside it: its document, its buffer views, its images.

A file that needs an extension that cannot be honoured, such as Draco, is refused in one sentence. glTF 2.0 specification, sections 3.6
(binary data) and 3.6.2.3 (sparse accessors); EXT_meshopt_compression and KHR_texture_basisu by the packages of the extra `web`.
"""

from __future__ import annotations

import base64
import binascii
import importlib.util
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.gltf.container import unpack_glb
from gsbake.imaging import ktx2

COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COMPONENT_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
#: Largest number of values that an accessor without data may state.
MAX_EMPTY = 50_000_000
#: Required extensions that are read; materials beyond metallic-roughness are named in `Document.ignored`.
READ = {
    "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_materials_unlit", "KHR_materials_emissive_strength",
    "MSFT_lod",
}  # fmt: skip
#: Required extensions without which the object still has its shape and its base colour.
IGNORED = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_node_visibility", "KHR_animation_pointer", "ADOBE_materials_")
MESHOPT, BASISU = "EXT_meshopt_compression", "KHR_texture_basisu"
#: {extension: package of the extra `web` that reads it}.
OPTIONAL = {MESHOPT: "meshopt", BASISU: "alktx2"}
#: Filters of EXT_meshopt_compression.
FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL")


@dataclass
class Document:
    """A parsed glTF file: its JSON `json`, its `buffers`, the `name` and `folder` it came from, its `size` in bytes with all its parts."""

    json: dict[str, Any]
    buffers: list[bytes]
    name: str
    folder: Path | None
    size: int
    _views: dict[int, bytes] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> Document:
        """Read a .glb or .gltf file. Raises BadInputError for what is not one or cannot be honoured."""
        try:
            data = path.read_bytes()
        except OSError as error:
            raise BadInputError(f"'{path}' cannot be read: {error.strerror}.") from error
        return cls.parse(data, str(path), path.parent)

    @classmethod
    def parse(cls, data: bytes, name: str, folder: Path | None = None) -> Document:
        """Parse the bytes of a file; files that it names are read from `folder` (None: refused)."""
        if data[:4] == b"glTF":
            document, binary = unpack_glb(data, name)
        else:
            binary = b""
            try:
                document = json.loads(data)
            except (ValueError, RecursionError) as error:
                raise BadInputError(f"'{name}' is neither a GLB nor a glTF file.") from error
        if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
            raise BadInputError(f"'{name}' is neither a GLB nor a glTF file.")
        if not str(document["asset"].get("version", "")).startswith("2"):
            raise BadInputError(f"'{name}' is glTF {document['asset'].get('version')}; gsbake reads glTF 2.0: convert it first.")
        out = cls(document, [], name, folder, len(data))
        with out.readable():
            required = [e for e in document.get("extensionsRequired", []) if e not in READ and not str(e).startswith(IGNORED)]
            missing = [e for e in required if e in OPTIONAL and importlib.util.find_spec(OPTIONAL[e]) is None]
            required = [e for e in required if e not in OPTIONAL]
            if missing and not required:
                package = OPTIONAL[missing[0]]
                remedy = "pip install 'gsbake[web]', or export it without"
                raise BadInputError(f"'{name}' needs {missing[0]}, which the package {package} reads: {remedy}.")
            if required:
                raise BadInputError(f"'{name}' needs {', '.join(map(str, required))}, which gsbake does not read; export it without.")
            for index, entry in enumerate(document.get("buffers", [])):
                out.buffers.append(out._buffer(index, entry, binary))
        return out

    def readable(self) -> _Readable:
        """Context in which a malformed document raises BadInputError with the file's name instead of KeyError and the like."""
        return _Readable(self.name)

    @property
    def ignored(self) -> list[str]:
        """Extensions in use that the reader leaves out."""
        return sorted(str(e) for e in self.json.get("extensionsUsed", []) if e not in READ and e not in OPTIONAL)

    def _buffer(self, index: int, entry: dict[str, Any], binary: bytes) -> bytes:
        if "uri" in entry:
            content = self.load(entry["uri"])
        else:
            content = binary if index == 0 else b""
            if index and entry.get("extensions", {}).get(MESHOPT, {}).get("fallback"):
                return content
        if len(content) < entry["byteLength"]:
            raise BadInputError(f"'{self.name}' is damaged: buffer {index} has {len(content)} of {entry['byteLength']} bytes.")
        return content

    def load(self, uri: str) -> bytes:
        """Content of a data URI, or of a file beside the document."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except (ValueError, binascii.Error) as error:
                raise BadInputError(f"'{self.name}' holds a damaged data URI.") from error
        if "://" in uri or self.folder is None:
            raise BadInputError(f"'{self.name}' refers to '{uri[:100]}', which is not a file beside it; pack it into one GLB.")
        try:
            path = (self.folder / unquote(uri)).resolve()
            if not path.is_relative_to(self.folder.resolve()) or not path.is_file():  # neither files elsewhere nor devices
                raise BadInputError(f"'{self.name}' needs the file '{uri[:100]}', which is not in its folder; pack it into one GLB.")
            content = path.read_bytes()
        except (OSError, ValueError) as error:
            raise BadInputError(f"'{self.name}' needs the file '{uri[:100]}' beside it, which cannot be read.") from error
        self.size += len(content)
        return content

    def view(self, index: int) -> bytes:
        """Bytes of a buffer view."""
        if index not in self._views:
            self._views[index] = self._slice(index, self.json["bufferViews"][index])
        return self._views[index]

    def _slice(self, index: int, view: dict[str, Any]) -> bytes:
        packed = view.get("extensions", {}).get(MESHOPT)
        if packed is not None and importlib.util.find_spec("meshopt") is not None:
            return _decoded(self._slice(index, {k: v for k, v in packed.items() if k != "extensions"}), packed, view["byteLength"])
        start, length = view.get("byteOffset", 0), view["byteLength"]
        content = self.buffers[view["buffer"]][start : start + length]
        if start < 0 or len(content) != length:
            raise ValueError(f"buffer view {index} exceeds its buffer")
        return content

    def accessor(self, index: int) -> NDArray[Any]:
        """Values of an accessor (count, width) as float32 if normalised, else in their own type; (count,) for scalars."""
        values = self.stored(index)
        if self.json["accessors"][index].get("normalized") and values.dtype.kind != "f":
            limit = np.float32(np.iinfo(values.dtype).max)
            values = np.maximum(values.astype(np.float32) / limit, np.float32(-1))
        return values[:, 0] if values.shape[1] == 1 else values

    def stored(self, index: int) -> NDArray[Any]:
        """Values of an accessor (count, width) in the type in which they are stored."""
        accessor = self.json["accessors"][index]
        kind, width, count = np.dtype(COMPONENT_TYPES[accessor["componentType"]]), COMPONENT_COUNTS[accessor["type"]], accessor["count"]
        if "bufferView" in accessor:
            stride = self.stride(accessor["bufferView"]) or kind.itemsize * width
            values = _strided(self.view(accessor["bufferView"]), kind, count, width, accessor.get("byteOffset", 0), stride)
        else:
            if not 0 <= count * width <= MAX_EMPTY:
                raise ValueError(f"accessor {index} states {count} values")
            values = np.zeros((count, width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            at, to, n = sparse["indices"], sparse["values"], sparse["count"]
            rows = _strided(self.view(at["bufferView"]), np.dtype(COMPONENT_TYPES[at["componentType"]]), n, 1, at.get("byteOffset", 0), 0)
            values[rows[:, 0]] = _strided(self.view(to["bufferView"]), kind, n, width, to.get("byteOffset", 0), 0)
        return values

    def stride(self, view: int) -> int | None:
        """Stride of a buffer view in bytes, or None where it has none."""
        found = self.json["bufferViews"][view].get("byteStride")
        return None if found is None else int(found)

    def image(self, index: int) -> bytes:
        """Encoded bytes of an image."""
        entry = self.json["images"][index]
        return self.load(entry["uri"]) if "uri" in entry else self.view(entry["bufferView"])


def texture_infos(material: dict[str, Any]) -> dict[str, Any]:
    """The texture entries of a material by role ("base_color", "orm", "occlusion", "normal", "emissive"), those that it has."""
    surface = material.get("pbrMetallicRoughness", {})
    found = {
        "base_color": surface.get("baseColorTexture"),
        "orm": surface.get("metallicRoughnessTexture"),
        "occlusion": material.get("occlusionTexture"),
        "normal": material.get("normalTexture"),
        "emissive": material.get("emissiveTexture"),
    }
    return {role: info for role, info in found.items() if info is not None}


def texture_source(document: dict[str, Any], texture: int) -> int | None:
    """Index of a texture's image, of its extension where it has one; None without."""
    entry = document["textures"][texture]
    extensions, source = entry.get("extensions", {}), entry.get("source")
    if "EXT_texture_webp" in extensions:
        return int(extensions["EXT_texture_webp"]["source"])
    if BASISU in extensions and (source is None or ktx2.available()):
        return int(extensions[BASISU]["source"])
    return None if source is None else int(source)


class _Readable:
    """Turns the errors of malformed documents into BadInputError."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (KeyError, IndexError, ValueError, TypeError, AttributeError, OverflowError, RuntimeError)):
            reason = " ".join(repr(error).split())[:200]
            raise BadInputError(f"'{self.name}' is not a valid glTF file ({reason}); export it again.") from error


def _strided(content: bytes, kind: np.dtype[Any], count: int, width: int, start: int, stride: int) -> NDArray[Any]:
    """A copy (count, width) of rows at `stride` bytes (0: tightly packed)."""
    stride = stride or kind.itemsize * width
    if start < 0 or count < 1 or stride < kind.itemsize * width or start + stride * (count - 1) + kind.itemsize * width > len(content):
        raise ValueError("an accessor exceeds its buffer view")
    return np.ndarray((count, width), kind, content, start, (stride, kind.itemsize)).copy()


def _decoded(content: bytes, packed: dict[str, Any], length: int) -> bytes:
    """The plain bytes of a compressed buffer view."""
    import meshopt

    count, stride, mode = int(packed["count"]), int(packed["byteStride"]), packed["mode"]
    kind = packed.get("filter", "NONE")
    if kind not in FILTERS or not 0 < count * stride <= 4 * MAX_EMPTY or count * stride > length:
        raise ValueError(f"a compressed buffer view states {count} rows of {stride} bytes with the filter {kind}")
    return bytes(meshopt.decode_gltf_buffer(content, count, stride, mode, kind).tobytes())


def decode_image(content: bytes, name: str) -> NDArray[np.uint8]:
    """Pixels (h, w, 4) 8-bit RGBA of a PNG, JPEG, WebP or KTX2 file. Raises BadInputError, which names `name`."""
    if content[:12] == ktx2.MAGIC:
        if not ktx2.available():
            raise BadInputError(f"{name} is a KTX2 image, which the package alktx2 reads: pip install 'gsbake[web]', or export it without.")
        try:
            return ktx2.decode_ktx2(content)
        except ValueError as error:
            raise BadInputError(f"{name} is a KTX2 image that cannot be decoded: {error}.") from error
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # more pixels than OpenCV decodes, or no bytes
        pixels = None
    if pixels is None:
        raise BadInputError(f"{name} cannot be decoded; it must be PNG, JPEG or WebP.")
    if pixels.dtype == np.uint16:
        pixels = (pixels.astype(np.uint32) * 255 // 65535).astype(np.uint8)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype != np.uint8:
        raise BadInputError(f"{name} has {pixels.dtype} pixels; glTF images have 8 or 16 bits.")
    opaque = np.full(pixels.shape[:2], 255, np.uint8)
    match pixels.shape[2]:
        case 1:
            planes = (pixels[..., 0], pixels[..., 0], pixels[..., 0], opaque)
        case 2:
            planes = (pixels[..., 0], pixels[..., 0], pixels[..., 0], pixels[..., 1])
        case 3:
            planes = (pixels[..., 2], pixels[..., 1], pixels[..., 0], opaque)
        case _:
            planes = (pixels[..., 2], pixels[..., 1], pixels[..., 0], pixels[..., 3])
    return np.ascontiguousarray(np.stack(planes, -1), np.uint8)


def image_format(content: bytes) -> str:
    """The format of an encoded image: "png", "jpeg", "webp", "ktx2" or "unknown"."""
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        return "png"
    if content[:3] == b"\xff\xd8\xff":
        return "jpeg"
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        return "webp"
    return "ktx2" if content[:12] == ktx2.MAGIC else "unknown"
