"""Any glTF file, GLB or JSON with files beside it: its document, its buffer views, its images.

A file that needs an extension that cannot be honoured, such as Draco, is refused in one sentence. glTF 2.0 specification, sections 3.6
(binary data) and 3.6.2.3 (sparse accessors); EXT_meshopt_compression and KHR_texture_basisu by the packages of the extra `web`.

Whatever is read or made of a document counts against one budget (`memory_budget`), before it is. Decompression of meshes stays in this
process: the decoder writes exactly the rows that the header states, which are counted, and checks its input.
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

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.gltf.container import unpack_glb
from gsbake.imaging import ktx2
from gsbake.memory_budget import budget, check, json_bytes, read_bytes, too_large

COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COMPONENT_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
#: Lists of objects at the top of a document.
LISTS = (
    "accessors", "animations", "buffers", "bufferViews", "cameras", "images", "materials", "meshes", "nodes", "samplers", "scenes", "skins",
    "textures",
)  # fmt: skip
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
#: What reading a malformed document raises.
FAULTS = (KeyError, IndexError, ValueError, TypeError, AttributeError, OverflowError, RuntimeError, MemoryError)
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
    _files: dict[str, bytes] = field(default_factory=dict)
    _left: int = field(default_factory=budget)

    @classmethod
    def open(cls, path: Path) -> Document:
        """Read a .glb or .gltf file. Raises BadInputError for what is not one or cannot be honoured."""
        try:
            data = read_bytes(path)
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
            check(json_bytes(data), f"'{name}'")
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
            check_structure(document)
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

    def spend(self, size: int) -> None:
        """Count `size` bytes that are about to be read or made. Raises BadInputError when the document needs more than there is."""
        if size < 0:
            raise ValueError(f"it states {size} bytes")
        if size > self._left:
            raise too_large(size, self._left, f"'{self.name}'")
        self._left -= size

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of a list of the document ("meshes", "accessors", …). Raises ValueError for an index that has none."""
        return entry_of(self.json, kind, index)

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
        if uri not in self._files:
            self._files[uri] = self._loaded(uri)
        return self._files[uri]

    def _loaded(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            self.spend(len(uri))
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
            self.spend(path.stat().st_size)
            content = path.read_bytes()
        except (OSError, ValueError) as error:
            raise BadInputError(f"'{self.name}' needs the file '{uri[:100]}' beside it, which cannot be read.") from error
        self.size += len(content)
        return content

    def view(self, index: int) -> bytes:
        """Bytes of a buffer view."""
        if index not in self._views:
            self._views[index] = self._slice(index, self.entry("bufferViews", index))
        return self._views[index]

    def _slice(self, index: int, view: dict[str, Any]) -> bytes:
        packed = view.get("extensions", {}).get(MESHOPT)
        self.spend(int(view["byteLength"]))
        if packed is not None and importlib.util.find_spec("meshopt") is not None:
            return _decoded(self._slice(index, {k: v for k, v in packed.items() if k != "extensions"}), packed, view["byteLength"])
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if not 0 <= view["buffer"] < len(self.buffers):
            raise ValueError(f"buffer view {index} names a buffer that does not exist")
        content = self.buffers[view["buffer"]][start : start + length]
        if start < 0 or length < 0 or len(content) != length:
            raise ValueError(f"buffer view {index} exceeds its buffer")
        return content

    def accessor(self, index: int) -> NDArray[Any]:
        """Values of an accessor (count, width) as float32 if normalised, else in their own type; (count,) for scalars."""
        values = self.stored(index)
        if self.entry("accessors", index).get("normalized") and values.dtype.kind != "f":
            limit = np.float32(np.iinfo(values.dtype).max)
            values = np.maximum(values.astype(np.float32) / limit, np.float32(-1))
        return values[:, 0] if values.shape[1] == 1 else values

    def stored(self, index: int) -> NDArray[Any]:
        """Values of an accessor (count, width) in the type in which they are stored."""
        accessor = self.entry("accessors", index)
        kind, width, count = np.dtype(COMPONENT_TYPES[accessor["componentType"]]), COMPONENT_COUNTS[accessor["type"]], self.count(index)
        if "bufferView" in accessor:
            stride = self.stride(accessor["bufferView"]) or kind.itemsize * width
            values = _strided(self.view(accessor["bufferView"]), kind, count, width, accessor.get("byteOffset", 0), stride)
        else:
            self.spend(count * width * kind.itemsize)
            values = np.zeros((count, width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            at, to, n = sparse["indices"], sparse["values"], sparse["count"]
            rows = _strided(self.view(at["bufferView"]), np.dtype(COMPONENT_TYPES[at["componentType"]]), n, 1, at.get("byteOffset", 0), 0)
            if not rows[:, 0].max() < count:
                raise ValueError(f"accessor {index} has sparse values of rows that it does not have")
            values[rows[:, 0]] = _strided(self.view(to["bufferView"]), kind, n, width, to.get("byteOffset", 0), 0)
        return values

    def count(self, index: int) -> int:
        """Number of rows that an accessor states. Raises ValueError for a number that is none."""
        count = self.entry("accessors", index)["count"]
        if type(count) is not int or not 1 <= count < 1 << 48:
            raise ValueError(f"accessor {index} states {str(count)[:50]} rows")
        return count

    def stride(self, view: int) -> int | None:
        """Stride of a buffer view in bytes, or None where it has none."""
        found = self.entry("bufferViews", view).get("byteStride")
        return None if found is None else int(found)

    def image(self, index: int) -> bytes:
        """Encoded bytes of an image."""
        entry = self.entry("images", index)
        return self.load(entry["uri"]) if "uri" in entry else self.view(entry["bufferView"])


def check_structure(document: dict[str, Any]) -> None:
    """Raise ValueError unless the lists of a document are lists of objects, as the specification has them."""
    for kind in LISTS:
        found = document.get(kind, [])
        if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
            raise ValueError(f"{kind} is no list of objects")
    for kind in ("extensionsUsed", "extensionsRequired"):
        if not isinstance(document.get(kind, []), list):
            raise ValueError(f"{kind} is no list")


def entry_of(document: dict[str, Any], kind: str, index: Any) -> dict[str, Any]:
    """Entry `index` of a list of the document. Raises ValueError where there is none: a negative index is none either."""
    found = document.get(kind, [])
    if type(index) is not int or not 0 <= index < len(found):
        raise ValueError(f"{kind} has no entry {str(index)[:50]!r}")
    entry: dict[str, Any] = found[index]
    return entry


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
    entry = entry_of(document, "textures", texture)
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
        if isinstance(error, FAULTS):
            raise BadInputError(f"'{self.name}' is not a valid glTF file ({reason_of(error)}); export it again.") from error


def reason_of(error: BaseException) -> str:
    """What is wrong with a document, from the error that reading it raised."""
    return " ".join((str(error) if type(error) is ValueError else repr(error)).split())[:200]


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
    if kind not in FILTERS or not 0 < count * stride <= length:
        raise ValueError(f"a compressed buffer view states {count} rows of {stride} bytes with the filter {kind}")
    return bytes(meshopt.decode_gltf_buffer(content, count, stride, mode, kind).tobytes())
