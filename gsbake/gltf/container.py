"""GLB container format: a header, one JSON chunk, one binary chunk.

glTF 2.0 specification, chapter 4 (GLB File Format Specification).
"""

from __future__ import annotations

import json
import struct
from typing import Any

from gsbake.errors import BadInputError
from gsbake.memory_budget import check, json_bytes

MAGIC, VERSION = 0x46546C67, 2
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def pack_glb(document: dict[str, Any], binary: bytes) -> bytes:
    """The bytes of a GLB with this JSON document and binary chunk; keys keep their order, so equal input gives equal bytes."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    return struct.pack("<III", MAGIC, VERSION, 12 + len(chunks)) + chunks


def unpack_glb(data: bytes, name: str) -> tuple[dict[str, Any], bytes]:
    """JSON document and binary chunk of a GLB; raises BadInputError, which names `name`, when the bytes are not a complete GLB."""
    if len(data) < 20 or struct.unpack_from("<I", data)[0] != MAGIC:
        raise BadInputError(f"{name} is not a GLB file.")
    _, version, length = struct.unpack_from("<III", data)
    if version != VERSION or length != len(data):
        raise BadInputError(f"{name} is damaged or not glTF 2.0 (version {version}, {len(data)} of {length} bytes); export it again.")
    document: dict[str, Any] | None = None
    binary = b""
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<II", data, offset)
        chunk = data[offset + 8 : offset + 8 + size]
        if len(chunk) != size:
            raise BadInputError(f"{name} is damaged: a chunk exceeds the file; export it again.")
        if kind == JSON_CHUNK and document is None:
            check(json_bytes(chunk), name)
            try:
                document = json.loads(chunk)
            except (ValueError, RecursionError) as error:
                raise BadInputError(f"{name} holds invalid JSON ({error}); export it again.") from error
        elif kind == BINARY_CHUNK and not binary:
            binary = chunk
        offset += 8 + size
    if not isinstance(document, dict):
        raise BadInputError(f"{name} has no JSON chunk; export it again.")
    return document, binary
