"""Builder of a GLB's binary chunk: buffer views and accessors, plain or compressed by meshoptimizer.

EXT_meshopt_compression: a compressed view lies in the binary chunk and stands for one in a second buffer, which has no data.
glTF 2.0 specification, section 3.6 (buffers, accessors).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

MESHOPT = "EXT_meshopt_compression"
BYTE, SHORT, UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5120, 5122, 5123, 5125, 5126
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
COMPONENTS = {"i1": BYTE, "i2": SHORT, "u2": UNSIGNED_SHORT, "u4": UNSIGNED_INT, "f4": FLOAT}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


@dataclass
class Buffer:
    """The binary chunk with its buffer views and accessors; with `compressed`, vertices and indices are encoded by meshoptimizer."""

    compressed: bool = False
    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    fallback: int = 0  # bytes of the buffer that compressed views stand for

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes at a multiple of four; returns the index of their buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        if target is not None:
            entry["target"] = target
        self.data += content
        self.views.append(entry)
        return len(self.views) - 1

    def attribute(self, values: NDArray[Any], bounds: bool = False) -> int:
        """Append vertex values (v, k), integers as normalised ones, rows at multiples of four bytes; the index of their accessor."""
        count, width = values.shape
        size = values.dtype.itemsize
        stride = -(-width * size // 4) * 4
        rows = np.zeros((count, stride // size), values.dtype)
        rows[:, :width] = values
        entry: dict[str, Any] = {
            "bufferView": self._encoded(rows, ARRAY_BUFFER, "ATTRIBUTES", stride if self.compressed or stride > width * size else None),
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "count": count,
            "type": KINDS[width],
        }
        if values.dtype.kind != "f":
            entry["normalized"] = True
        if bounds:
            entry |= {"min": [x.item() for x in values.min(0)], "max": [x.item() for x in values.max(0)]}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def indices(self, faces: NDArray[Any], vertices: int) -> int:
        """Append triangles (f, 3) of a mesh with so many `vertices`; the index of their accessor."""
        # 65535 is the primitive-restart value of 16-bit indices and may not be used.
        corners = np.ascontiguousarray(faces, "<u2" if vertices < 65535 else "<u4").ravel()
        self.accessors.append({
            "bufferView": self._encoded(corners, ELEMENT_ARRAY_BUFFER, "TRIANGLES", None),
            "componentType": COMPONENTS[corners.dtype.str[1:]],
            "count": len(corners),
            "type": "SCALAR",
        })  # fmt: skip
        return len(self.accessors) - 1

    def entries(self) -> list[dict[str, Any]]:
        """The document's buffers."""
        out: list[dict[str, Any]] = [{"byteLength": len(self.data) + -len(self.data) % 4}]
        if self.fallback:
            out.append({"byteLength": self.fallback, "extensions": {MESHOPT: {"fallback": True}}})
        return out

    def _encoded(self, rows: NDArray[Any], target: int, mode: Literal["ATTRIBUTES", "TRIANGLES"], stride: int | None) -> int:
        if not self.compressed:
            index = self.view(rows.tobytes(), target)
            if stride is not None:
                self.views[index]["byteStride"] = stride
            return index
        import meshopt

        content = meshopt.encode_gltf_buffer(rows, mode)
        index = self.view(content)
        stored = self.views[index]
        size = rows.nbytes // len(rows)
        place = {"buffer": 0, "byteOffset": stored["byteOffset"], "byteLength": len(content)}
        extension = {**place, "byteStride": size, "count": len(rows), "mode": mode}
        self.fallback += -self.fallback % 4
        entry = {"buffer": 1, "byteOffset": self.fallback, "byteLength": rows.nbytes, "target": target, "extensions": {MESHOPT: extension}}
        if stride is not None:
            entry["byteStride"] = stride
        self.fallback += rows.nbytes
        self.views[index] = entry
        return index
