"""The distance that is known before training: to the oriented points of the initial surfels (stereo, hull, tie points), or to a sphere.

Near the points it is the moving least squares of their planes (Kolluri 2005). Far from them it is the distance to the nearest point, with
the sign by flooding a coarse lattice from its border: a plane's sign is wrong behind an edge, the flood's only where the points leave a
hole larger than a cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial import cKDTree

from gsbake.geometry.vectors import unit
from gsbake.surfels.spacing import surfel_spacing

Floats = NDArray[np.float64]

#: Points whose planes are blended, and the standard deviation of their weights in point spacings.
NEIGHBOURS, WIDTH = 8, 0.7
#: Distance in spacings within which planes are blended.
NEAR_SPACINGS = 2.5
#: Cells along the longest side of the lattice that is flooded.
FLOOD_CELLS = 64
#: Radius (in spacings, at least one cell) of the wall that the flood does not cross.
WALL_SPACINGS = 1.5


class KnownDistance:
    """Signed distance to oriented points, negative inside."""

    def __init__(self, points: Floats, normals: Floats) -> None:
        """`points` (n, 3) in the unit frame and outward unit `normals` (n, 3); those that are not finite are ignored."""
        fine = np.isfinite(points).all(1) & np.isfinite(normals).all(1)
        self.points, self.normals = np.asarray(points[fine], float), np.asarray(normals[fine], float)
        if not len(self.points):  # nothing is known: the unit ball
            self.points, self.normals = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 1.0]])
        spacing = surfel_spacing(self.points)
        self.spacing = float(spacing) if np.isfinite(spacing) and spacing > 0 else 0.05
        self.tree = cKDTree(self.points)
        self._flood()

    @property
    def box(self) -> tuple[Floats, Floats]:
        """Lower and upper corner (3,) of the points with a margin of a sixteenth of the longest side."""
        lower, upper = self.points.min(0), self.points.max(0)
        margin = max(float((upper - lower).max()) / 16, 4 * self.spacing)
        return lower - margin, upper + margin

    def _flood(self) -> None:
        """Mark the cells of a coarse lattice that are connected to its border without crossing the points."""
        lower, upper = self.box
        self._cell = float((upper - lower).max()) / FLOOD_CELLS
        self._lower = lower - 2 * self._cell
        shape = np.ceil((upper - lower) / self._cell).astype(int) + 5
        centres = self._lower + self._cell * np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)
        distance = self.tree.query(centres.reshape(-1, 3), workers=-1)[0].reshape(shape)
        wall = distance < max(WALL_SPACINGS * self.spacing, 0.9 * self._cell)
        regions, _ = label(~wall)
        self._outside = (regions == regions[0, 0, 0]) & ~wall
        self._inside = ~self._outside & ~wall

    def __call__(self, query: NDArray[np.floating]) -> NDArray[np.float32]:
        """Signed distances (n,) at `query` (n, 3)."""
        return self.with_gradient(query)[0]

    def with_gradient(self, query: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Signed distances (n,) at `query` (n, 3), and unit gradients (n, 3): blended normals near the points, else the direction away from
        the nearest one."""
        x = np.nan_to_num(np.asarray(query, float), nan=0.0, posinf=1e6, neginf=-1e6)
        k = min(NEIGHBOURS, len(self.points))
        distance, index = self.tree.query(x, k=range(1, k + 1), workers=-1)
        nearest = distance[:, 0]
        weight = np.exp(-(distance**2 - nearest[:, None] ** 2) / (2 * (WIDTH * self.spacing) ** 2))
        plane = np.einsum("nkc,nkc->nk", self.normals[index], x[:, None] - self.points[index])
        blended = (weight * plane).sum(1) / weight.sum(1)
        cell = np.clip(np.rint((x - self._lower) / self._cell).astype(int), 0, np.array(self._outside.shape) - 1)
        outside, inside = self._outside[tuple(cell.T)], self._inside[tuple(cell.T)]
        outside |= ((x < self._lower) | (x > self._lower + self._cell * (np.array(self._outside.shape) - 1))).any(1)
        sign = np.where(outside, 1.0, np.where(inside, -1.0, np.where(blended < 0, -1.0, 1.0)))
        near = nearest < NEAR_SPACINGS * self.spacing
        value = np.where(near, np.clip(blended, -nearest, nearest), sign * nearest)
        normal = np.einsum("nk,nkc->nc", weight, self.normals[index])
        slope = np.where(near[:, None], normal, sign[:, None] * (x - self.points[index[:, 0]]))
        return value.astype(np.float32), unit(slope).astype(np.float32)


class SphereDistance:
    """Signed distance to a sphere around the origin: the start when nothing is to be known."""

    def __init__(self, radius: float) -> None:
        """`radius` in the unit frame."""
        self.radius, self.spacing = radius, radius / 50
        self.points = np.zeros((0, 3))

    @property
    def box(self) -> tuple[Floats, Floats]:
        """Lower and upper corner (3,) with a margin."""
        edge = self.radius * 1.0625
        return np.full(3, -edge), np.full(3, edge)

    def __call__(self, query: NDArray[np.floating]) -> NDArray[np.float32]:
        """Signed distances (n,) at `query` (n, 3)."""
        return self.with_gradient(query)[0]

    def with_gradient(self, query: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Signed distances (n,) at `query` (n, 3), and unit gradients (n, 3)."""
        x = np.asarray(query, float)
        return (np.linalg.norm(x, axis=1) - self.radius).astype(np.float32), unit(x).astype(np.float32)


Known = KnownDistance | SphereDistance
