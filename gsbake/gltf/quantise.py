"""Quantised vertices: positions and texture coordinates as 16-bit fractions, normals and tangents as signed 16-bit ones.

KHR_mesh_quantization; the node's uniform scale and translation bring positions back, so that normals keep their directions. Positions are
exact to half a 65 535th of the longest edge of the bounding box.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTIZATION = "KHR_mesh_quantization"
#: Largest values of unsigned and signed 16-bit fractions.
UNSIGNED, SIGNED = 65535, 32767


@dataclass(frozen=True)
class Placement:
    """Position = `scale` · fraction + `translation` (3,)."""

    scale: float
    translation: NDArray[np.float64]

    @staticmethod
    def of(*positions: NDArray[Any]) -> Placement:
        """The placement that brings all positions (v, 3) into 0..1; one for all levels of detail, which then share their seams."""
        low = np.min([p.min(0) for p in positions], 0).astype(np.float64)
        high = np.max([p.max(0) for p in positions], 0).astype(np.float64)
        return Placement(float((high - low).max()) or 1.0, low)

    def node(self) -> dict[str, Any]:
        """The node's transform."""
        return {"scale": [self.scale] * 3, "translation": self.translation.tolist()}

    def fractions(self, position: NDArray[Any]) -> NDArray[np.uint16]:
        """Positions (v, 3) as fractions."""
        return unsigned((position.astype(np.float64) - self.translation) / self.scale)


def unsigned(values: NDArray[Any]) -> NDArray[np.uint16]:
    """Values 0..1 as 16-bit fractions."""
    return np.asarray(np.rint(np.clip(values, 0, 1).astype(np.float64) * UNSIGNED), "<u2")


def signed(values: NDArray[Any]) -> NDArray[np.int16]:
    """Values −1..1 as signed 16-bit fractions."""
    return np.asarray(np.rint(np.clip(values, -1, 1).astype(np.float64) * SIGNED), "<i2")


def with_area(position: NDArray[np.uint16], faces: NDArray[Any]) -> NDArray[Any]:
    """The triangles (f, 3) whose three corners differ after quantisation."""
    key = position.astype(np.int64) @ np.array([1 << 32, 1 << 16, 1])
    corner = key[faces]
    keep = (corner[:, 0] != corner[:, 1]) & (corner[:, 1] != corner[:, 2]) & (corner[:, 2] != corner[:, 0])
    return np.asarray(faces[keep])
