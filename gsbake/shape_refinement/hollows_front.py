"""A front that moves inwards from a visual hull where photos disagree about its colour.

It is a level set on a grid (Osher & Sethian 1988). Where colours disagree it moves inwards (Kutulakos & Seitz, *A theory of shape by space
carving*, IJCV 2000), where they agree by the Gauss–Newton step of their parallax (`hollows_kernel`). The speed is a mean over neighbours,
in which a vertex counts by what its photos say: a plain patch follows the others. The front never leaves the hull, stays where silhouettes
determine the surface, and keeps a wall before the opposite side. It remembers the disagreement in every cell that it passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.raycast import RayCaster
from gsbake.kernels.threads import run_chunks
from gsbake.shape_refinement.hollows_cut import cut_cells
from gsbake.shape_refinement.hollows_kernel import parallax_rows
from gsbake.shape_refinement.samples import Doubles, Photo, sample_photos
from gsbake.shape_refinement.surface import Surface

Floats = NDArray[np.float32]

#: Distances are kept up to this many cells.
REACH = 3.0


@dataclass(frozen=True)
class FrontOptions:
    """Settings. Distances in cells, colours in sRGB 0..1."""

    #: Inward step where colours disagree, and the longest step.
    pressure: float = 0.5
    most: float = 0.7
    #: Colours disagree from this multiple of the deviation on parts that silhouettes determine, which is at least `floor`.
    noise: float = 2.5
    floor: float = 0.012
    #: A vertex has to be seen by more photos than this.
    views: int = 3
    #: Half-steps of averaging of the variance over neighbours.
    averaging: int = 12
    #: Share of the samples' information that counts, deviation of a Gauss–Newton step, weight of a vertex whose photos say nothing.
    independent: float = 0.3
    move: float = 1.0
    silent: float = 0.02
    #: Smoothing of the speed and of the surface, and its share.
    speed_sigma: float = 1.5
    surface_sigma: float = 0.8
    smoothing: float = 0.3
    #: Thickness that stays before the opposite side, and the share of what is more that a step may take.
    wall: float = 2.0
    wall_share: float = 0.3
    #: Steps between renewals of the distance.
    renew_every: int = 3
    #: Greatest disagreement and its power in the cost of a cut, and what its area costs.
    most_cost: float = 6.0
    power: float = 4.0
    area: float = 0.002


class Front:
    """The front: `distance` (n, n, n) in cells, negative inside, at least `least`, that of the hull `start`; `room` (n, n, n) in cells is
    how far a cell may move, 0 or less where the surface stays."""

    def __init__(self, start: Hull, room: Floats) -> None:
        self.start, self.least = start, np.asarray(np.clip(start.field / start.cell, -REACH, REACH), np.float32)
        self.distance, self.free = self.least, np.asarray(np.clip(room, 0, 1), np.float32)
        self._base = self.distance  # after the last cut
        self._quiet: float | None = None
        self._cost = np.full(self.distance.shape, np.inf, np.float32)
        self._steps = 0

    def hull(self) -> Hull:
        """The shape now."""
        return replace(self.start, occupancy=self.distance < 0, field=np.asarray(self.distance * self.start.cell, np.float32))

    def step(self, photos: Sequence[Photo], options: FrontOptions) -> str:
        """Move by one step, by `photos` in sRGB; what it did in words."""
        cell = self.start.cell
        vertices, corners = self.hull().triangles()
        vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(corners, np.int32)
        surface = Surface(len(vertices), faces)
        normals = surface.normals(vertices)
        samples = sample_photos(vertices, normals, faces, photos)
        rows = np.zeros((len(vertices), 4))
        fixed = (samples.colour, samples.slope, samples.weight, options.floor, rows)
        run_chunks(lambda start, stop: parallax_rows(start, stop, *fixed), len(vertices))
        place = tuple(np.clip(np.floor((vertices - self.start.lower) / cell), 0, len(self.distance) - 1).astype(np.int64).T)
        count = (samples.weight > 0).sum(1)
        left = unexplained(rows, cell)
        variance = surface.averaged(left, options.averaging).astype(float)
        relative = variance / self._threshold(left, count > 0, self.free[place] == 0, options)
        cost = np.where(count > options.views, np.minimum(relative, options.most_cost), options.most_cost)
        np.minimum.at(self._cost, place, cost.astype(np.float32))
        disagree = np.clip(count / options.views - 1, 0, 1) * relative**2 / (1 + relative**2)
        factor = options.independent / (variance / 3 + options.floor**2) * cell**2
        information = rows[:, 0] * factor
        newton = -rows[:, 1] * factor / cell / (information + 1 / options.move**2)
        speed = (1 - disagree) * newton - disagree * options.pressure
        thickness = RayCaster(vertices, faces).first_hit(vertices - 0.01 * cell * normals, -normals).distance.astype(float) / cell
        most = options.wall_share * np.clip(thickness - options.wall, 0, None)
        weight = (-speed > most) + disagree + (1 - disagree) * information / (1 + information) + options.silent * (count > 0)
        move = self._spread(place, np.maximum(speed, -most), weight, options)
        moved = self.distance - move
        smooth = ndimage.gaussian_filter(moved, options.surface_sigma)
        moved += options.smoothing * np.minimum(np.abs(move) / 0.1, 1) * self.free * (smooth - moved)
        self.distance = np.where(self.free > 0, np.maximum(moved, self.least), self.least).astype(np.float32)
        self._steps += 1
        if self._steps % options.renew_every == 0:
            self._renew()
        return f"{len(vertices)} vertices, {100 * disagree.mean():.0f} % disagree, move {np.abs(move[place]).mean():.3f} cells"

    def _threshold(self, variance: Doubles, seen: NDArray[np.bool_], hard: NDArray[np.bool_], options: FrontOptions) -> float:
        """Variance from which colours disagree: highlights on the hull at the start raise it."""
        if self._quiet is None:
            rows = seen & hard if (seen & hard).any() else seen
            self._quiet = float(np.median(variance[rows])) if rows.any() else 1.0
        return options.noise**2 * max(self._quiet, options.floor**2)

    def _spread(self, place: tuple[NDArray[np.int64], ...], speed: Doubles, weight: Doubles, options: FrontOptions) -> Floats:
        """The moves (n, n, n): the weighted mean of the speeds of vertices nearby."""
        shape = self.distance.shape
        flat = np.ravel_multi_index(place, shape)
        total, known = (
            ndimage.gaussian_filter(np.bincount(flat, values, minlength=self.distance.size).reshape(shape), options.speed_sigma)
            for values in (speed * weight, weight)
        )
        mean = np.divide(total, known, out=np.zeros_like(total), where=known > 1e-6)
        return np.asarray(np.clip(mean, -options.most, options.most) * self.free, np.float32)

    def cut(self, options: FrontOptions) -> None:
        """Go back to the surface that the photos agreed on most since the last cut."""
        before, left = self._base < 0, self.distance < 0
        removed = before & ~left
        if removed.any():
            unknown = ~np.isfinite(self._cost)
            nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
            air = cut_cells(removed, left, self._cost[tuple(nearest)] ** options.power, options.area)
            solid = before & ~air
            signed = np.where(solid, 0.5 - ndimage.distance_transform_edt(solid), ndimage.distance_transform_edt(~solid) - 0.5)
            signed = ndimage.gaussian_filter(np.clip(signed, -REACH, REACH), options.surface_sigma)
            near = ndimage.binary_dilation(air, iterations=2)
            self._base = np.where(near, np.maximum(signed, self._base), self._base).astype(np.float32)
        self.distance = self._base
        self._cost = np.full(self.distance.shape, np.inf, np.float32)

    def _renew(self) -> None:
        """Make `distance` the distance from its zero level again."""
        slope = np.sqrt(sum(np.square(g) for g in np.gradient(self.distance)))
        size = np.abs(self.distance)
        cells = np.argwhere(size < REACH)
        vertices, _ = self.hull().triangles()
        nearest, _ = cKDTree((vertices - self.start.lower) / self.start.cell - 0.5).query(cells, distance_upper_bound=REACH)
        exact = np.full(self.distance.shape, REACH, np.float32)
        exact[tuple(cells.T)] = np.minimum(nearest, REACH)
        near = np.minimum(size / np.clip(slope, 0.4, 2.5), 1.5)  # finer than the spacing of the vertices
        renewed = np.sign(self.distance) * np.where((size < 1) & (exact < 1.5), near, exact)
        self.distance = np.where(self.free > 0, np.maximum(renewed, self.least), self.least).astype(np.float32)


def unexplained(rows: Doubles, most: float) -> Doubles:
    """What a displacement of at most `most` along the normal leaves of the variance (v,): `rows` (v, 4) as from `parallax_rows`."""
    best = np.clip(-rows[:, 1] / np.maximum(rows[:, 0], 1e-30), -most, most)
    return np.asarray(np.maximum(rows[:, 2] + (2 * rows[:, 1] * best + rows[:, 0] * best**2) / np.maximum(rows[:, 3], 1e-30), 0))
