"""Hollows of a visual hull, opened where photos disagree about the colour of their lids.

A visual hull has a lid on every hollow, and stereo measures nothing in a hollow without texture. Photos disagree about the colour of a lid:
each sees another part of the hollow through it (`hollows_lids`). A hollow is proposed under each lid: what is farther from the rest of the
hull's surface than some thickness of the wall, for several thicknesses. Photos that a surface's colours were not fitted to say how well
it predicts them (`hollows_prediction`): the best thickness is taken, or the best at each part of the wall, where the hollow predicts
much better than the lid with reflections. Only what photos see through the lid is opened. Stereo measures the surface afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.raycast import RayCaster
from gsbake.shape_refinement.hollows_lids import BLOCK, find_lids, hull_mesh, surface_cells
from gsbake.shape_refinement.hollows_prediction import FLOOR, Prediction, diffuse_errors
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.surface import Doubles

Floats = NDArray[np.float32]
Cells = NDArray[np.bool_]

#: Depth in cells below the hull from which a vertex is a hollow's.
INSIDE = 1.5
#: Blocks along the wall over which errors and thicknesses are averaged (standard deviation), and the difference of logarithms of errors by
#: which a thickness counts 1/e.
ALONG, SOFTNESS = 3.0, 0.25
#: Stands for the logarithm of an error that is not known.
UNKNOWN = 100.0



@dataclass(frozen=True)
class HollowOptions:
    """Settings. Lengths in cells of the hull, of which the longest side of the object has about 100."""

    #: Longer side in pixels of the photos.
    size: int = 150
    #: Thicknesses of the wall that are tried.
    thicknesses: tuple[float, ...] = (2.0, 2.5, 3.1, 3.9, 4.9, 6.1, 7.6, 9.5, 11.9)
    #: Least cells of a hollow.
    cells: int = 100
    #: The error of a hollow's surface, as a share of the lid's, up to which it is opened: hollows of development objects reach .001 to .04,
    #: other parts .06 and more. At least so many vertices, as a share of the lid's, have to be seen: others 0 to .3.
    share: float = 0.07
    seen: float = 0.6
    #: The largest error of a hollow's surface, a tenth of the brightness squared: hollows reach .006; other parts have
    #: .02 and more, or .12 of their lid's.
    error: float = 0.01
    #: A thicker wall, or one of uneven thickness, is preferred up to this factor on the least error.
    tolerance: float = 1.2
    #: Thicknesses end at this factor on the least error.
    end: float = 5.0
    #: Photos that have to see a cell.
    photos: int = 2


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
    with masks. `on_step` is called before each proposal, and may raise.
    """
    options = options or HollowOptions()
    photos = load_photos(options.size)
    opened, verdicts = hull, []
    for lid in find_lids(hull, softness, photos):
        shape, found = _Hollow(opened, lid.cells, photos, options, on_step).best(lid.prediction)
        before = opened
        better = found.error <= min(options.share * lid.prediction.error, options.error)
        if better and found.seen >= options.seen * lid.prediction.seen:
            opened = seen_part(opened, shape, photos, options.photos)
        verdicts.append(Verdict(lid.vertices, lid.prediction.error, found.error, int((before.occupancy & ~opened.occupancy).sum())))
    return opened, verdicts


def with_field(hull: Hull, field: NDArray[np.floating]) -> Hull:
    """The hull with other signed distances."""
    return replace(hull, field=np.asarray(field, np.float32), occupancy=field < 0)


@dataclass(frozen=True)
class _Proposal:
    """A `shape` with a hollow of the cells `air` (n, n, n), its wall's `thickness`, and the `vertices` (v, 3) of its surface that predict
    photos, with their `errors` (v,)."""

    shape: Hull
    air: Cells
    thickness: float
    vertices: Doubles
    errors: Floats
    prediction: Prediction


class _Hollow:
    """Proposals for the hollow under one lid, `lid` (n, n, n), of a `hull`."""

    def __init__(self, hull: Hull, lid: Cells, photos: Sequence[Photo], options: HollowOptions, on_step: Callable[[], None]) -> None:
        self.hull, self.photos, self.options, self.on_step = hull, photos, options, on_step
        surface = surface_cells(hull.occupancy)
        self.lid = lid & surface
        # Below all of the surface but the lid, and where that is nearest.
        self.depth, self.wall = ndimage.distance_transform_edt(~(surface & ~lid), return_indices=True)

    def best(self, closed: Prediction) -> tuple[Hull, Prediction]:
        """The proposal that predicts best, or a thicker one that does about as well, and how it does; NaN where there is none."""
        options, tried = self.options, []
        for thickness in options.thicknesses:
            air = self._air(thickness)
            if air.sum() < options.cells:
                break
            proposal = self._propose(air, np.full(1, thickness))
            if proposal.prediction.seen < 0.5 * options.seen * closed.seen:
                break
            tried.append(proposal)
            if proposal.prediction.error > options.end * min(one.prediction.error for one in tried):
                break
        able = [one for one in tried if one.prediction.seen >= options.seen * closed.seen]
        if not able:
            return self.hull, Prediction(float("nan"), 0)
        most = options.tolerance * min(one.prediction.error for one in able)
        best = [one for one in able if one.prediction.error <= most][-1]
        if best.prediction.error <= 2 * options.share * closed.error:
            uneven = self._propose(tried[0].air, self._local_thickness(tried))
            if uneven.prediction.error <= most and uneven.prediction.seen >= options.seen * closed.seen:
                best = uneven
        return best.shape, best.prediction

    def _propose(self, air: Cells, thickness: NDArray[np.floating]) -> _Proposal:
        """What of the `air` (n, n, n) is below walls of this thickness, one value or that of each cell (n, n, n)."""
        self.on_step()
        below = np.asarray(self.depth - thickness, np.float32)
        air = air & (below > 0)
        distance = np.clip(np.where(air, np.maximum(below, 0.2), np.minimum(below, -0.05)), -3, 3)
        near = ndimage.binary_dilation(air, iterations=3) & self.hull.occupancy
        shape = with_field(self.hull, np.where(near, np.maximum(self.hull.field, distance * self.hull.cell), self.hull.field))
        vertices, faces = hull_mesh(shape)
        errors = diffuse_errors(vertices, faces, self.photos)
        inside = (self.hull.signed_distance(vertices) < -INSIDE * self.hull.cell) & np.isfinite(errors)
        inside &= ndimage.binary_dilation(air, iterations=3)[self.hull.cells_of(vertices)]
        return _Proposal(shape, air, float(thickness.flat[0]), vertices[inside], errors[inside], Prediction.of(errors[inside]))

    def _local_thickness(self, tried: Sequence[_Proposal]) -> Floats:
        """The thickness (n, n, n) of the nearest wall that predicts best there: errors are averaged along the wall, thicknesses weighted by
        them."""
        n = len(self.hull.field) // BLOCK
        shape, means = (n, n, n), []
        for proposal in tried:
            cells = self.hull.cells_of(proposal.vertices)
            flat = np.ravel_multi_index(tuple(axis[cells] // BLOCK for axis in self.wall), shape)
            logarithms = np.log(np.minimum(proposal.errors, 1) + FLOOR)
            sums = (np.bincount(flat, weights, n**3).reshape(shape) for weights in (logarithms, np.ones(len(flat))))
            total, count = (ndimage.gaussian_filter(values, ALONG) for values in sums)
            means.append(np.where(count > 1e-4, total / np.maximum(count, 1e-9), UNKNOWN))
        best = np.min(means, axis=0)
        known = best < UNKNOWN
        weights = np.exp((best - np.stack(means)) / SOFTNESS)
        thickness = np.einsum("k,kxyz->xyz", [one.thickness for one in tried], weights) / weights.sum(0)
        smooth = ndimage.gaussian_filter(thickness * known, ALONG) / np.maximum(ndimage.gaussian_filter(known.astype(float), ALONG), 1e-9)
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        return np.asarray(smooth[tuple(nearest)][tuple(axis // BLOCK for axis in self.wall)], np.float32)

    def _air(self, thickness: float) -> Cells:
        """Cells (n, n, n) deeper than the thickness that are connected to the lid."""
        air = self.hull.occupancy & (self.depth > thickness)
        label, count = ndimage.label(air | self.lid)
        keep = np.bincount(label[air], minlength=count + 1) >= self.options.cells
        keep &= np.isin(np.arange(count + 1), label[self.lid])
        keep[0] = False
        return np.asarray(air & keep[label])


def seen_part(hull: Hull, shape: Hull, photos: Sequence[Photo], least: int) -> Hull:
    """`shape` where at least `least` photos see through its hollows, elsewhere the hull."""
    vertices, faces = hull_mesh(shape)
    caster = RayCaster(vertices, faces)
    cells = np.argwhere(hull.occupancy & ~shape.occupancy)
    centres, seen = hull.lower + (cells + 0.5) * hull.cell, np.zeros(len(cells), np.int64)
    for camera in (photo.camera for photo in photos):
        depth = caster.depth(camera)
        pixel, z = camera.project(centres)
        visible = camera.in_view(pixel, z)
        column, row = np.floor(pixel[visible]).astype(np.int64).T
        seen[np.flatnonzero(visible)] += z[visible] < depth[row, column]
    through = np.zeros(hull.field.shape, bool)
    through[tuple(cells.T)] = seen >= least
    through |= ndimage.binary_closing(through, iterations=2)
    return with_field(hull, np.where(ndimage.binary_dilation(through, iterations=2), shape.field, hull.field))
