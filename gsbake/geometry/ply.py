"""Points and triangle meshes as binary little-endian PLY (Turk, *The PLY polygon file format*, 1994)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Property names of a record's vector fields; a scalar field's property has the field's name.
PROPERTIES = {"position": ("x", "y", "z"), "normal": ("nx", "ny", "nz"), "colour": ("red", "green", "blue")}
#: PLY names of the supported scalar types.
TYPES = {"<f4": "float", "|u1": "uchar"}

#: Names of texture coordinates that programs write; those of corners are the list `texcoord`.
TEXTURE_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
#: Longest header that is looked at, in bytes.
MAX_HEADER = 1 << 16

#: Record of a coloured point.
COLOURED_POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])


def _header(record: np.dtype[Any], count: int) -> bytes:
    """PLY header of `count` points with the fields of `record`."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    for name in record.names or ():
        kind = TYPES[record[name].base.str]
        lines += [f"property {kind} {prop}" for prop in PROPERTIES.get(name, (name,))]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def write_points(path: Path, rows: NDArray[Any]) -> None:
    """Write the structured array `rows` (n,): vector fields of `PROPERTIES`, scalar fields of 32-bit floats or bytes."""
    path.write_bytes(_header(rows.dtype, len(rows)) + rows.tobytes())


def read_points(path: Path, record: np.dtype[Any]) -> NDArray[Any]:
    """Read a structured array (n,) written by `write_points`. Raises ValueError for a PLY with other properties."""
    data = path.read_bytes()
    end = data.find(b"end_header\n") + len(b"end_header\n")
    count = next((int(line[15:]) for line in data[:end].splitlines() if line.startswith(b"element vertex ")), 0)
    if data[:end] != _header(record, count) or len(data) - end != count * record.itemsize:
        raise ValueError(f"{path} does not contain points with {', '.join(record.names or ())}")
    return np.frombuffer(data, record, count, end)


def write_cloud(path: Path, points: ArrayLike, colours: ArrayLike) -> None:
    """Write `points` (n, 3) and 8-bit `colours` (n, 3)."""
    xyz = np.asarray(points, float).reshape(-1, 3)
    rows = np.zeros(len(xyz), COLOURED_POINT)
    rows["position"], rows["colour"] = xyz, np.asarray(colours, np.uint8).reshape(-1, 3)
    write_points(path, rows)


def read_cloud(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read points (n, 3) and colours (n, 3) written by `write_cloud`. Raises ValueError for any other PLY."""
    rows = read_points(path, COLOURED_POINT)
    return rows["position"].astype(np.float64), rows["colour"].copy()


def write_mesh(path: Path, vertices: ArrayLike, faces: ArrayLike, uv: ArrayLike | None = None) -> None:
    """Write `vertices` (v, 3), in single precision, triangles `faces` (f, 3), and texture coordinates `uv` (v, 2), origin bottom left."""
    points = np.asarray(vertices, "<f4").reshape(-1, 3)
    coordinates = "" if uv is None else "property float s\nproperty float t\n"
    if uv is not None:
        points = np.ascontiguousarray(np.concatenate([points, np.asarray(uv, "<f4").reshape(-1, 2)], 1))
    corners = np.asarray(faces, "<i4").reshape(-1, 3)
    rows = np.zeros(len(corners), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"] = 3
    rows["corners"] = corners
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n{coordinates}"
        f"element face {len(corners)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + points.tobytes() + rows.tobytes())


def has_texture_coordinates(path: Path) -> bool:
    """Whether the header of a PLY names texture coordinates of its vertices or of its corners."""
    with path.open("rb") as file:
        header = file.read(MAX_HEADER).partition(b"end_header")[0]
    found = {line.split()[-1].decode("latin-1") for line in header.splitlines() if line.startswith(b"property ")}
    return "texcoord" in found or any(found.issuperset(names) for names in TEXTURE_COORDINATES)


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (v, 3) and triangles (f, 3) of any PLY mesh. Raises ValueError as `read_textured_mesh`."""
    vertices, faces, _ = read_textured_mesh(path)
    return vertices, faces


def read_textured_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
    """Read vertices (v, 3), triangles (f, 3) and texture coordinates (v, 2), origin bottom left, None without any, of any PLY mesh.

    It is read in this process: its counts are checked against its length by the reader, and a stage that a person has replaced a file of is
    a process of its own. Raises ValueError for an unreadable file, no triangles, corners that are no vertices, or non-finite positions.
    """
    import trimesh

    try:
        content = io.BytesIO(path.read_bytes())  # without a name, from which the reader would open textures
        mesh: Any = trimesh.load(content, file_type="ply", process=False)
        vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    except MemoryError:
        raise
    except Exception as error:  # damaged headers cause exceptions of many types in the reader
        raise ValueError(f"{path} is not a readable triangle mesh ({' '.join(str(error).split())[:200]})") from error
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise ValueError(f"{path} has no triangles or has non-finite positions")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path} has triangles with corners that are no vertices")
    uv = getattr(mesh.visual, "uv", None)
    return vertices, faces, None if uv is None or np.shape(uv) != (len(vertices), 2) else np.asarray(uv, np.float64)
