"""The child process that reads a mesh from outside (PLY, OBJ, STL), and its parent's side; see `limited_process` for why.

The reader, trimesh, opens what a file names (materials, textures) when it has the file's folder: it is given the content alone.
"""

from __future__ import annotations

import io
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.limited_process import ParserProcess, limit_memory, read_in_child, serve
from gsbake.memory_budget import check, child_limit

#: File name suffixes of the formats.
SUFFIXES = (".ply", ".obj", ".stl")
#: Faces of an OBJ, and those with texture coordinates.
_OBJ_FACE = {False: re.compile(rb"^f[ \t]", re.MULTILINE), True: re.compile(rb"^f[ \t]+-?\d+/-?\d", re.MULTILINE)}
#: Bytes that reading takes per byte of the file (text is split into Python's objects), and beyond: libraries, what the allocator reserves.
MEMORY_FACTOR, SPARE_MEMORY = 24, 1 << 30
#: Seconds that a mesh may take: at least, and per byte of the file (half a megabyte a second).
MIN_SECONDS, SECONDS_PER_BYTE = 60.0, 2e-6
#: Largest coordinate: beyond, single precision overflows.
MAX_COORDINATE = 1e15


@dataclass(frozen=True)
class ForeignMesh:
    """`vertices` (v, 3), none beyond MAX_COORDINATE, triangles `faces` (f, 3), texture coordinates `uv` (v, 2) with the origin bottom left.

    NaN where a part has no texture coordinates, None where none has; `materials` is the number of those that the file names, at least 1.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    materials: int = 1


def read_foreign_mesh(path: Path) -> ForeignMesh:
    """A mesh of another program; its polygons are triangulated. Raises BadInputError."""
    name = f"'{path}'"
    if path.suffix.lower() not in SUFFIXES:
        raise BadInputError(f"{name} is not a readable mesh; give a GLB, glTF, {', '.join(s[1:].upper() for s in SUFFIXES)} file.")
    try:
        size = path.stat().st_size
    except OSError as error:
        raise BadInputError(f"{name} cannot be read: {error.strerror}.") from error
    needed = MEMORY_FACTOR * size
    check(needed, name)
    with tempfile.TemporaryDirectory(prefix="gsbake-mesh-") as scratch, ParserProcess(__name__) as child:
        target = Path(scratch, "mesh.npz")
        request = {"path": str(path.absolute()), "name": name, "target": str(target), "needed": needed}
        read_in_child(child, request, MIN_SECONDS + SECONDS_PER_BYTE * size, name)
        with np.load(target, allow_pickle=False) as body:
            uv = body["uv"]
            return ForeignMesh(body["vertices"], body["faces"], None if np.isnan(uv).all() else uv, int(body["materials"]))


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Write the arrays of the mesh in "path" to "target" (NPZ). Errors: {"error": sentence}."""
    import trimesh

    path, name = Path(request["path"]), str(request["name"])
    limit_memory(child_limit(int(request["needed"]), SPARE_MEMORY))
    try:
        options: dict[str, Any] = {"skip_materials": True} if path.suffix.lower() == ".obj" else {}
        content = path.read_bytes()  # given without a name: with an open file the reader would go on to others
        with np.errstate(all="ignore"):  # its warnings of numbers that are checked below
            loaded: Any = trimesh.load(io.BytesIO(content), file_type=path.suffix.lower()[1:], process=False, **options)
        parts = [part for part in getattr(loaded, "geometry", {"": loaded}).values() if isinstance(part, trimesh.Trimesh)]
        start = np.cumsum([0, *(len(part.vertices) for part in parts)])
        vertices = np.concatenate([np.zeros((0, 3)), *(np.asarray(part.vertices, np.float64).reshape(-1, 3) for part in parts)])
        corners = (np.asarray(part.faces, np.int64).reshape(-1, 3) + first for part, first in zip(parts, start, strict=False))
        faces = np.concatenate([np.zeros((0, 3), np.int64), *corners])
        uv = np.concatenate([np.zeros((0, 2)), *(_texture_coordinates(part) for part in parts)])
        materials = len(set(re.findall(rb"^usemtl[ \t]+(.*?)\s*$", content, re.MULTILINE))) if options else 1
        total, mapped = (len(_OBJ_FACE[uv].findall(content)) if options else 0 for uv in (False, True))
    except OSError as error:
        return {"error": f"{name} cannot be read: {error.strerror or error}."}
    except MemoryError:
        raise
    except Exception as error:  # the readers of trimesh raise what they come across
        return {"error": f"{name} is not a readable mesh ({' '.join(repr(error).split())[:120]})."}
    if len(faces) == 0 or not (np.abs(vertices) <= MAX_COORDINATE).all() or faces.min() < 0 or faces.max() >= len(vertices):
        return {"error": f"{name} holds no triangles, or vertices that are not finite or beyond {MAX_COORDINATE:g}."}
    if 0 < mapped < total:  # trimesh drops all of them
        return {"error": f"{name} has no UVs on {total - mapped} of its {total} faces; unwrap all of it, or none."}
    np.savez(Path(request["target"]), vertices=vertices, faces=faces, uv=uv, materials=max(1, materials))
    return {}


def _texture_coordinates(part: Any) -> NDArray[np.float64]:
    """Those (v, 2) of a mesh of trimesh; NaN where it has none."""
    found = getattr(part.visual, "uv", None)
    missing = np.full((len(part.vertices), 2), np.nan)
    return missing if found is None or np.shape(found) != missing.shape else np.asarray(found, np.float64)


def main() -> None:
    """Answer requests until the parent closes the pipe."""
    serve(answer)
