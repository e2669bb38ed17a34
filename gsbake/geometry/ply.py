"""Coloured point clouds as binary PLY (Turk 1994)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

_ROW = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
)


def write_cloud(path: Path, points: ArrayLike, colours: ArrayLike) -> None:
    """Write `points` (n, 3) and 8-bit `colours` (n, 3)."""
    xyz = np.asarray(points, float).reshape(-1, 3)
    rows = np.zeros(len(xyz), _ROW)
    rows["xyz"], rows["rgb"] = xyz, np.asarray(colours, np.uint8).reshape(-1, 3)
    path.write_bytes(_HEADER.format(len(rows)).encode("ascii") + rows.tobytes())


def read_cloud(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points (n, 3) and colours (n, 3) that `write_cloud` wrote. Raises ValueError for any other PLY."""
    data = path.read_bytes()
    end = data.find(b"end_header\n") + len(b"end_header\n")
    count = next((int(line.split()[2]) for line in data[:end].splitlines() if line.startswith(b"element vertex")), 0)
    if data[:end] != _HEADER.format(count).encode("ascii") or len(data) - end != count * _ROW.itemsize:
        raise ValueError(f"{path} is no point cloud of this program")
    rows = np.frombuffer(data, _ROW, count, end)
    return rows["xyz"].astype(np.float64), rows["rgb"].copy()
