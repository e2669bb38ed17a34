"""Hollows of a visual hull, opened where photos disagree about the colour of their lids.

A visual hull has a lid on every hollow, and stereo measures nothing in a hollow without texture. Photos disagree about the colour of a lid:
each sees another part of the hollow through it (`hollows_lids`). A hollow is proposed under each lid: what is farther from the rest of the
hull's surface than some thickness of the wall, for several thicknesses. Photos that a surface's colours were not fitted to say how well
it predicts them (`hollows_prediction`): the best thickness is taken, or a minimum cut between all of them (`hollows_cut`), where it
predicts much better than the lid with reflections. Only what photos see through the lid is opened. Stereo measures the surface afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.raycast import RayCaster
from gsbake.shape_refinement.hollows_cut import cut_cells
from gsbake.shape_refinement.hollows_lids import find_lids, hull_mesh, surface_cells
from gsbake.shape_refinement.hollows_prediction import HeldOut, Prediction
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.surface import Surface

Floats = NDArray[np.float32]
Cells = NDArray[np.bool_]

#: Rings of neighbours to which a known prediction extends, and as how many photos one counts that sees such a surface.
RINGS, KNOWN = 3, 2


@dataclass(frozen=True)
class HollowOptions:
    """Settings. Lengths in cells of the hull, of which the longest side of the object has about 100."""

    #: Longer side in pixels of the photos.
    size: int = 150
    #: Thicknesses of the wall that are tried.
    thicknesses: tuple[float, ...] = (2.0, 2.5, 3.1, 3.9, 4.9, 6.1, 7.6, 9.5, 11.9)
    #: Least cells of a hollow.
    cells: int = 100
    #: The error of a hollow's surface, as a share of the lid's, up to which it is opened: hollows of development objects reach .001 to .03,
    #: other parts .08 and more. At least so many vertices, as a share of the lid's, have to be seen: others 0 to .3.
    share: float = 0.05
    seen: float = 0.6
    #: A thicker wall is preferred up to this factor on the least error; the cut has to have less than this factor.
    thicker: float = 1.6
    cut: float = 0.9
    #: Thicknesses end at this factor on the least error.
    end: float = 5.0
    #: Photos that have to see a cell; those that see a surface of known prediction behind it count twice.
    photos: int = 4


@dataclass(frozen=True)
class Verdict:
    """A lid of `vertices` vertices: errors of the lid and of the hollow's surface (`Prediction.error`), NaN where too little was seen of
    one, and the `cells` that were opened, 0 for a hollow that was refused."""

    vertices: int
    closed: float
    opened: float
    cells: int


def open_hollows(
    hull: Hull, softness: Floats, load_photos: Callable[[int], Sequence[Photo]], options: HollowOptions | None = None,
    *, on_step: Callable[[], None] = lambda: None,
) -> tuple[Hull, list[Verdict]]:  # fmt: skip
    """The hull (n, n, n), n even, with its hollows opened, and what was decided about each lid.

    `softness` (n, n, n) as from `surface_softness`; `load_photos` returns the photos, their longer side at most a number of pixels, all
    with masks. Raises ValueError for an empty hull.
    """
    options = options or HollowOptions()
    held_out = HeldOut.split(load_photos(options.size))
    opened, verdicts = hull, []
    for lid in find_lids(hull, softness, held_out):
        on_step()
        shape, found = _Hollow(opened, lid.cells, held_out, options).best(lid.prediction)
        before = opened
        if found.error <= options.share * lid.prediction.error and found.seen >= options.seen * lid.prediction.seen:
            opened = seen_part(opened, shape, held_out, options.photos)
        verdicts.append(Verdict(lid.vertices, lid.prediction.error, found.error, int((before.occupancy & ~opened.occupancy).sum())))
    return opened, verdicts


def with_field(hull: Hull, field: NDArray[np.floating]) -> Hull:
    """The hull with other signed distances."""
    return replace(hull, field=np.asarray(field, np.float32), occupancy=field < 0)


class _Hollow:
    """Proposals for the hollow under one lid, `lid` (n, n, n), of a `hull`."""

    def __init__(self, hull: Hull, lid: Cells, held_out: HeldOut, options: HollowOptions) -> None:
        self.hull, self.held_out, self.options = hull, held_out, options
        surface = surface_cells(hull.occupancy)
        self.lid = lid & surface
        self.depth = ndimage.distance_transform_edt(~(surface & ~lid))  # below all of the surface but the lid
        self._points: list[NDArray[np.float64]] = []
        self._errors: list[Floats] = []

    def best(self, closed: Prediction) -> tuple[Hull, Prediction]:
        """The proposal that predicts best, the thicker of those that predict about as well, and how it does."""
        options, tried = self.options, []
        for thickness in options.thicknesses:
            air = self._air(thickness)
            if air.sum() < options.cells:
                break
            distance = np.where(air, np.maximum(self.depth - thickness, 0.2), np.minimum(self.depth - thickness, -0.05))
            shape = with_field(self.hull, self._field(air, distance))
            found = self._predict(shape, air)
            if found.seen < 0.5 * options.seen * closed.seen:
                break
            tried.append((air, thickness, shape, found))
            if found.error > options.end * min(row[3].error for row in tried):
                break
        rows = [row for row in tried if row[3].seen >= options.seen * closed.seen]
        if not rows:
            return self.hull, Prediction(float("nan"), 0)
        least = min(row[3].error for row in rows)
        _, _, shape, found = [row for row in rows if row[3].error <= options.thicker * least][-1]
        if least <= 2 * options.share * closed.error:
            cut = self._cut(tried[0][0], tried[-1][1])
            by_cut = self._predict(cut, cut.field >= 0)
            if by_cut.error < options.cut * least and by_cut.seen >= options.seen * closed.seen:
                return cut, by_cut
        return shape, found

    def _air(self, thickness: float) -> Cells:
        """Cells (n, n, n) deeper than the thickness that are connected to the lid."""
        air = self.hull.occupancy & (self.depth > thickness)
        label, count = ndimage.label(air | self.lid)
        keep = np.bincount(label[air], minlength=count + 1) >= self.options.cells
        keep &= np.isin(np.arange(count + 1), label[self.lid])
        keep[0] = False
        return np.asarray(air & keep[label])

    def _field(self, air: Cells, distance: NDArray[np.floating]) -> NDArray[np.floating]:
        """The hull's distances with a `distance` (n, n, n) in cells in and near the air, positive in it."""
        near = ndimage.binary_dilation(air, iterations=3) & self.hull.occupancy
        return np.where(near, np.maximum(self.hull.field, np.clip(distance, -3, 3) * self.hull.cell), self.hull.field)

    def _predict(self, shape: Hull, air: Cells) -> Prediction:
        """How the surface of `shape` in the hull's inside, around the `air`, predicts; keeps the errors for the cut."""
        vertices, faces = hull_mesh(shape)
        errors = self.held_out.errors(vertices, faces, reflections=False)
        inside = (self.hull.signed_distance(vertices) < -1.5 * self.hull.cell) & np.isfinite(errors)
        inside &= ndimage.binary_dilation(air, iterations=3)[self.hull.cells_of(vertices)]
        self._points.append(vertices[inside])
        self._errors.append(errors[inside])
        return Prediction.of(errors[inside])

    def _cut(self, air: Cells, deepest: float) -> Hull:
        """The surface of least error in the `air`, between the thinnest wall and one of `deepest` cells."""
        cells = np.argwhere(ndimage.binary_dilation(air))
        points, errors = np.concatenate(self._points), np.minimum(np.concatenate(self._errors), 1)
        distance, nearest = cKDTree(points).query(self.hull.lower + (cells + 0.5) * self.hull.cell, k=min(4, len(points)))
        weight = 1 / (distance.reshape(len(cells), -1) / self.hull.cell + 0.5) ** 2
        cost = np.zeros(air.shape, np.float32)
        cost[tuple(cells.T)] = 100 * (weight * errors[nearest].reshape(weight.shape)).sum(1) / weight.sum(1)
        removed = air & (self.depth <= deepest)
        left = self.hull.occupancy & ~air
        kept = cut_cells(removed, left, cost, 0.02) | (air & ~removed)
        signed = np.where(kept, ndimage.distance_transform_edt(kept) - 0.5, 0.5 - ndimage.distance_transform_edt(~kept))
        return with_field(self.hull, self._field(kept, ndimage.gaussian_filter(np.clip(signed, -3, 3), 0.8)))


def seen_part(hull: Hull, shape: Hull, held_out: HeldOut, least: int) -> Hull:
    """`shape` where at least `least` photos see through its hollows, elsewhere the hull."""
    vertices, faces = hull_mesh(shape)
    known = np.isfinite(held_out.errors(vertices, faces, reflections=False))
    adjacency = Surface(len(vertices), faces).adjacency
    for _ in range(RINGS):
        known |= adjacency @ known > 0
    caster = RayCaster(vertices, faces)
    cells = np.argwhere(hull.occupancy & ~shape.occupancy)
    centres, seen = hull.lower + (cells + 0.5) * hull.cell, np.zeros(len(cells), np.int64)
    for camera in (photo.camera for photo in held_out.photos):
        hits = caster.first_hit(camera.centre[None], camera.rays().reshape(-1, 3))
        weight = np.where(known[faces[np.maximum(hits.face, 0)]].any(1), KNOWN, 1)
        there = np.where(hits.hit, hits.distance, 0)
        pixel, z = camera.project(centres)
        visible = camera.in_view(pixel, z)
        column, row = np.floor(pixel[visible]).astype(np.int64).T
        pixel = row * camera.width + column
        seen[np.flatnonzero(visible)] += weight[pixel] * (z[visible] < there[pixel])
    through = np.zeros(hull.field.shape, bool)
    through[tuple(cells.T)] = seen >= least
    through |= ndimage.binary_closing(through, iterations=2)
    return with_field(hull, np.where(ndimage.binary_dilation(through, iterations=2), shape.field, hull.field))
