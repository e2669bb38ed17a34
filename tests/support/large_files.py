"""Small files that ask for much memory."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path
from typing import Any

from gsbake.gltf.container import pack_glb

TERABYTE = 10**12


def sparse_file(path: Path, size: int = TERABYTE, head: bytes = b"") -> Path:
    """A file of `size` bytes that takes a few on the disk."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(size)
    return path


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_header(width: int, height: int) -> bytes:
    """A PNG of 8-bit RGB that states a size, and holds next to nothing of it."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", zlib.compress(bytes(1000))) + png_chunk(b"IEND", b"")


def many_primitives(count: int, primitives: int, nodes: int = 1) -> dict[str, Any]:
    """A .gltf document without data: one accessor of `count` positions, all zero but one, in so many primitives of so many nodes."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(16)).decode()
    sparse = {"count": 1, "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 1}}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * primitives}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3", "sparse": sparse}],
        "bufferViews": [{"buffer": 0, "byteLength": 4}, {"buffer": 0, "byteOffset": 4, "byteLength": 12}],
        "buffers": [{"byteLength": 16, "uri": uri}],
    }


def textured_glb(image: bytes) -> bytes:
    """A GLB of one triangle with this image as its base colour."""
    corners = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<6f", 0, 0, 1, 0, 0, 1)
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 2, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": len(image)},
        ],
        "buffers": [{"byteLength": 60 + len(image)}],
    }  # fmt: skip
    return pack_glb(document, corners + image)


def write_json(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document))
    return path
