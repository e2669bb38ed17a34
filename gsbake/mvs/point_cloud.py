"""The fused points: oriented, coloured, with size and trust, as binary PLY (Turk 1994)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ROW = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3), ("radius", "<f4"), ("confidence", "<f4"), ("views", "u1")])
_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "property float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    "property float radius\nproperty float confidence\nproperty uchar views\nend_header\n"
)


@dataclass(frozen=True)
class StereoCloud:
    """Oriented points in the unit frame.

    `points` (n, 3), `normals` (n, 3) unit and outward, `colours` (n, 3) 8-bit sRGB, `radius` (n,) of the pixel that saw the point,
    `confidence` (n,) in 0..1, `views` (n,) that agreed.
    """

    points: Array
    normals: Array
    colours: NDArray[np.uint8]
    radius: Array
    confidence: Array
    views: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> StereoCloud:
        """The points at `index` (indices or a mask)."""
        return StereoCloud(
            self.points[index], self.normals[index], self.colours[index], self.radius[index], self.confidence[index], self.views[index]
        )

    def save(self, path: Path) -> None:
        """Write as PLY."""
        rows = np.zeros(len(self), _ROW)
        rows["xyz"], rows["normal"], rows["rgb"] = self.points, self.normals, self.colours
        rows["radius"], rows["confidence"], rows["views"] = self.radius, self.confidence, self.views
        path.write_bytes(_HEADER.format(len(rows)).encode("ascii") + rows.tobytes())

    @staticmethod
    def load(path: Path) -> StereoCloud:
        """Read what `save` wrote. Raises ValueError for any other PLY."""
        data = path.read_bytes()
        end = data.find(b"end_header\n") + len(b"end_header\n")
        count = next((int(line.split()[2]) for line in data[:end].splitlines() if line.startswith(b"element vertex")), 0)
        if data[:end] != _HEADER.format(count).encode("ascii") or len(data) - end != count * _ROW.itemsize:
            raise ValueError(f"{path} is no cloud of the stereo stage")
        rows = np.frombuffer(data, _ROW, count, end)
        wide = {k: rows[k].astype(np.float64) for k in ("xyz", "normal", "radius", "confidence")}
        return StereoCloud(wide["xyz"], wide["normal"], rows["rgb"].copy(), wide["radius"], wide["confidence"], rows["views"].copy())
