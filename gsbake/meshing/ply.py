"""Triangle meshes as binary PLY (Turk 1994): positions in single precision and faces, nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike


def write_ply(path: Path, vertices: ArrayLike, faces: ArrayLike) -> None:
    """Write `vertices` (v, 3) and `faces` (f, 3)."""
    points = np.asarray(vertices, "<f4").reshape(-1, 3)
    corners = np.asarray(faces, "<i4").reshape(-1, 3)
    rows = np.zeros(len(corners), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"] = 3
    rows["corners"] = corners
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(corners)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(points.tobytes())
        file.write(rows.tobytes())
