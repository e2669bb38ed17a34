"""The region that is baked: a box in any orientation. What lies outside is not matched, trained or meshed.

Its file is JSON: `centre` (3), `size` (3), the lengths of its edges, and `rotation` (3, 3), whose columns are the directions of these
edges; without it they are the axes. Units and axes are those of the cameras.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera, Similarity

#: Largest deviation of RᵀR from the identity that is attributed to rounding in a text file.
RIGID_TOLERANCE = 1e-2
#: Largest coordinate and edge, and its inverse the smallest edge: lengths beyond are those of no object in any unit.
MAX_LENGTH = 1e9
#: Largest file of a region in bytes.
MAX_BYTES = 10_000
#: Pairs of corners that edges join, as `Region.corners` orders them.
EDGES = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1)


@dataclass(frozen=True)
class Region:
    """A box: `centre` (3,), `size` (3,) of its edges, `rotation` (3, 3) from its axes to those of the frame."""

    centre: Array
    size: Array
    rotation: Array

    @staticmethod
    def of(numbers: Sequence[float], source: str) -> Region:
        """The box of 15 numbers: centre, size, rotation by rows. Raises BadInputError, which names the `source`, for what is no box."""
        values = np.asarray(numbers, float)
        if values.shape != (15,) or not (np.abs(values) <= MAX_LENGTH).all() or not (values[3:6] >= 1 / MAX_LENGTH).all():
            raise BadInputError(f"The region of {source} is no box: it needs a centre, three positive edges, and a rotation.")
        rotation = values[6:].reshape(3, 3)
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
            raise BadInputError(f"The rotation of the region of {source} is none: it scales, shears or mirrors.")
        u, _, vt = np.linalg.svd(rotation)
        return Region(values[:3], values[3:6], u @ vt)

    @staticmethod
    def read(path: Path) -> Region:
        """The box of a file. Raises BadInputError for a file that is none."""
        try:
            with path.open("rb") as file:
                body = json.loads(file.read(MAX_BYTES))
            parts = [np.asarray(body[key], float).reshape(3) for key in ("centre", "size")]
            parts.append(np.asarray(body.get("rotation", np.eye(3)), float).reshape(9))
            numbers = np.concatenate(parts).tolist()
        except OSError as error:
            raise BadInputError(f"The region '{path}' cannot be read: {error.strerror}.") from error
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise BadInputError(
                f"'{path}' is no region: it is JSON with a centre [x, y, z], a size [x, y, z] and, where it is turned, a rotation of 3 × 3."
            ) from error
        return Region.of(numbers, f"'{path}'")

    @property
    def numbers(self) -> list[float]:
        """The 15 numbers of `of`."""
        return [float(x) for x in np.concatenate([self.centre, self.size, self.rotation.ravel()])]

    @property
    def document(self) -> dict[str, Any]:
        """The contents of its file."""
        return {"centre": self.centre.tolist(), "size": self.size.tolist(), "rotation": self.rotation.tolist()}

    @property
    def corners(self) -> Array:
        """The eight corners (8, 3); corners whose indices differ in one bit are joined by an edge."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        return np.asarray(self.centre + (signs * self.size) @ self.rotation.T)

    def moved(self, frame: Similarity) -> Region:
        """The box in the frame that `frame` leads to."""
        return Region(frame.apply(self.centre), frame.scale * self.size, frame.rotation @ self.rotation)

    def distance(self, points: NDArray[Any]) -> Array:
        """Distance (...) of points (..., 3) to the box, negative inside."""
        apart = np.abs((points - self.centre) @ self.rotation) - self.size / 2
        return np.asarray(np.linalg.norm(np.maximum(apart, 0), axis=-1) + np.minimum(apart.max(-1), 0))

    def contains(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Which points (..., 3) lie in the box."""
        return np.asarray(self.distance(points) <= 0)

    def clamped(self, points: Array) -> Array:
        """The nearest points (n, 3) of the box to points (n, 3)."""
        local = (points - self.centre) @ self.rotation
        inside = np.clip(local, -self.size / 2, self.size / 2)
        return np.asarray(np.where((inside == local).all(-1, keepdims=True), points, self.centre + inside @ self.rotation.T))

    def silhouette(self, camera: Camera) -> NDArray[np.uint8]:
        """Pixels (h, w) of a pinhole camera that show the box, 255, and others, 0; all where the box lies beside the camera."""
        import cv2

        pixels, depth = camera.project(self.corners)
        out = np.zeros((camera.height, camera.width), np.uint8)
        if depth.max() <= 0:
            return out
        if depth.min() <= 1e-6 * float(self.size.max()):
            return np.full_like(out, 255)
        near = np.clip(np.rint(16 * (pixels - 0.5)), -(2**26), 2**26).astype(np.int32)  # four fractional bits; centres of pixels at .5
        cv2.fillConvexPoly(out, cv2.convexHull(near), 255, shift=4)
        return out
