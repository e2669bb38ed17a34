"""Carving of the visual hull by free-space votes of stereo depths.

A visual hull fills every concavity. Few depths there pass the full consistency check (specular or textureless surface, nearby edges), yet
far more pixels have a depth that one or two other photos share, and most of those lie behind the hull's surface. So depths vote on the
hull's cells: a depth behind a cell votes for free space, a depth in the cell for surface, a depth before it does not vote (Hernández,
Vogiatzis & Cipolla, *Probabilistic visibility for multi-view stereo*, CVPR 2007, as plain counts). Free space that is connected to
the outside is carved, but only where the exposed surface has votes of its own: mirror images lie behind a specular surface too, but mostly
at a different location in every photo.

Mirror images that do agree (a smooth black handle reflects the same light to many photos) are detected by silhouettes, in three ways.
Depths behind a hard part of the hull's surface do not vote (`gsbake.mvs.mirror_images`). A region must open through a soft part, where
silhouettes leave room for air (`gsbake.capture.hull.softness`). And every ray through the hull must still meet the object after carving
(Laurentini, *The visual hull concept*, PAMI 1994: the hull is the largest such shape). Carving a concavity keeps this property; carving a
convex part leaves empty rays in photos from the side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.rays import camera_arrays, concatenate_images, half_steps_inside, project_point
from gsbake.capture.hull.softness import SOFT
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.kernels.declaration import kernel
from gsbake.mvs.mirror_images import behind_hard_parts
from gsbake.mvs.ncc import FASTMATH

Floats = NDArray[np.float32]

#: A depth votes for surface within this many cells of the cell's centre.
SURFACE_BAND = 0.5
#: Gaussian smoothing of the votes in cells (standard deviation): single cells get few votes.
VOTE_SIGMA = 1.0
#: Free space has this share of the votes. The prior adds votes for surface: at least the second, or the third as a share of the median
#: number of votes per free cell, whichever is more.
MIN_FREE_SHARE, PRIOR_VOTES, PRIOR_VOTE_SHARE = 0.65, 0.3, 0.2
#: The same for cells that join a carved region (hysteresis: Canny, *A computational approach to edge detection*, PAMI 1986); cells at most
#: this far below a hard part of the hull's surface do not join.
MIN_JOINING_FREE_SHARE, JOINING_PRIOR_VOTES, JOINING_PRIOR_VOTE_SHARE, HARD_DEPTH = 0.75, 0.1, 0.1, 1.5
#: Carved regions have at least this many cells; fewer are noise.
MIN_REGION_CELLS = 8
#: A cell violates silhouettes when carving leaves this many photos with an empty ray through it (single masks may be wrong). Regions
#: with more than this share of such cells are rejected: true concavities have up to .03 of them, false ones .1 to .67.
MIN_EMPTY_RAYS, MAX_EMPTY_SHARE = 2, 0.1


@dataclass(frozen=True)
class RegionLimits:
    """What a carved region must have: a mean share of `surface` votes on the surface that it exposes, a share of its opening in the hull's
    surface that is `soft`, and cells in that `opening` as a multiple of its size to the power of 2/3: a bowl has 1.9, what spread below
    the surface from a leak .7 and less."""

    surface: float
    soft: float
    opening: float = 0.0


#: Limits of a region: either many votes for its surface or a soft opening. Behind a glossy front most depths are mirror images, whose votes
#: are less than the first and which open through less than the second.
REGION = (RegionLimits(0.12, 0.15), RegionLimits(0.05, 0.3))
#: Those of what is left of a region that violates silhouettes, without its hard cells.
REMAINDER = (RegionLimits(0.0, 0.6, 1.0),)


@dataclass(frozen=True)
class CarvedHull:
    """The carved `hull`, the `share` of cells carved, and the numbers of regions carved, rejected for lack of surface votes or because they
    open through a hard part, and rejected because they violate silhouettes."""

    hull: Hull
    share: float
    carved_regions: int
    unsupported_regions: int
    silhouette_violations: int


@kernel(
    "f4[:, :, ::1], f8[::1], f8, f8, f4[::1], i8[::1], i8[:, ::1], f8[:, ::1], f8[:, :, ::1], f4[:, :, ::1], f4[:, :, ::1]",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def _count_votes(
    field: Any, lower: Any, cell: float, band: float, depth: Any, starts: Any, sizes: Any, intrinsics: Any, poses: Any,
    free: Any, surface: Any,
) -> None:  # fmt: skip
    """Kernel of `count_votes`: all depth maps concatenated in `depth`."""
    n0, n1, n2 = field.shape
    for i in range(n0):
        x = lower[0] + (i + 0.5) * cell
        for j in range(n1):
            y = lower[1] + (j + 0.5) * cell
            for k in range(n2):
                if not field[i, j, k] < cell:
                    continue
                z = lower[2] + (k + 0.5) * cell
                for v in range(starts.shape[0]):
                    column, row, here = project_point(x, y, z, poses[v], intrinsics[v], sizes[v])
                    if not here > 0:
                        continue
                    there = depth[np.uint64(starts[v] + row * sizes[v, 0] + column)]
                    if not there > 0:
                        continue
                    if there > here + band:
                        free[i, j, k] += np.float32(1)
                    elif there > here - band:
                        surface[i, j, k] += np.float32(1)


@kernel(
    "i8[::1, :], b1[:, :, ::1], f8[::1], f8, i8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1]",
    fastmath=FASTMATH, error_model="numpy", nogil=True,
)
def _count_empty_rays(
    cells: Any, left: Any, lower: Any, cell: float, sizes: Any, intrinsics: Any, poses: Any, centres: Any, out: Any
) -> None:
    """Kernel of `count_empty_rays`."""
    for m in range(cells.shape[0]):
        i, j, k = cells[m, 0] + 0.5, cells[m, 1] + 0.5, cells[m, 2] + 0.5
        x, y, z = lower[0] + i * cell, lower[1] + j * cell, lower[2] + k * cell
        for v in range(poses.shape[0]):
            if not project_point(x, y, z, poses[v], intrinsics[v], sizes[v])[2] > 0:
                continue
            out[m] += half_steps_inside(left, i, j, k, x - centres[v, 0], y - centres[v, 1], z - centres[v, 2], 1) == 0


def count_empty_rays(cells: NDArray[np.int64], left: NDArray[np.bool_], hull: Hull, cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """Number of photos (m,) whose ray through a cell of the hull, `cells` (m, 3), meets none of the cells `left` (n, n, n)."""
    out = np.zeros(len(cells), np.int64)
    if len(cells) and cameras:
        _count_empty_rays(cells, left, np.asarray(hull.lower, float), float(hull.cell), *camera_arrays(cameras), out)
    return out


def count_votes(hull: Hull, cameras: Sequence[Camera], depths: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Votes (n, n, n) for free space (depth behind the cell) and surface (depth within half a cell), for cells in or next to the hull.

    `depths` are z-depths (h, w) of the cameras' sizes, 0 = none.
    """
    free, surface = np.zeros(hull.field.shape, np.float32), np.zeros(hull.field.shape, np.float32)
    if not cameras:
        return free, surface
    lower, cell = np.asarray(hull.lower, float), float(hull.cell)
    _count_votes(
        hull.field, lower, cell, SURFACE_BAND * cell, *concatenate_images(depths), *camera_arrays(cameras)[:3], free, surface
    )
    return free, surface


def carve_hull(hull: Hull, cameras: Sequence[Camera], depths: Sequence[Floats], softness: Floats) -> CarvedHull:
    """Carve from the hull what the `depths` (h, w; 0 = none) of the `cameras` see through; `softness` as from `surface_softness`.

    The signed distance of cells at the new surface follows from the share of free-space votes: the surface lies where that share is
    MIN_FREE_SHARE, up to a cell before the true one. This is the safe side: surfels behind the true surface are occluded.
    """
    behind = behind_hard_parts(hull, softness, cameras, depths)
    true = [np.where(mirrored, 0, depth).astype(np.float32) for depth, mirrored in zip(depths, behind, strict=True)]
    votes, surface = (ndimage.gaussian_filter(v, VOTE_SIGMA) for v in count_votes(hull, cameras, true))
    solid = hull.field < 0
    likely_free = solid & (votes > MIN_FREE_SHARE * (votes + surface))
    if not likely_free.any():
        return CarvedHull(hull, 0.0, 0, 0, 0)
    total = votes + surface + max(PRIOR_VOTES, PRIOR_VOTE_SHARE * float(np.median((votes + surface)[likely_free])))
    free_share, surface_share, hard = votes / total, surface / total, _hard_cells(solid, softness)
    free = solid & (free_share > MIN_FREE_SHARE)
    label, keep, unsupported = _carvable_regions(free, solid, surface_share, softness, REGION)
    violating = _violates_silhouettes(label, keep, solid, hull, cameras)
    carved, regions = (keep & ~violating)[label], int((keep & ~violating).sum())
    if violating.any():
        label, keep, _ = _carvable_regions(free & violating[label] & ~hard, solid, surface_share, softness, REMAINDER)
        keep &= ~_violates_silhouettes(label, keep, solid, hull, cameras)
        carved, regions = carved | keep[label], regions + int(keep.sum())
    if carved.any():
        typical = float(np.median((votes + surface)[carved]))
        weaker = votes / (votes + surface + max(JOINING_PRIOR_VOTES, JOINING_PRIOR_VOTE_SHARE * typical))
        grown = _grow(carved, np.where(hard, 0, weaker), hull, cameras)
        free_share, carved = np.where(grown, weaker, free_share), carved | grown
    if not carved.any() or carved[solid].all():  # nothing to carve, or nothing would be left
        return CarvedHull(hull, 0.0, 0, unsupported, int(violating.sum()))
    # The share of free-space votes falls by about a quarter per cell across a new surface.
    edge = np.where(ndimage.binary_dilation(carved), (free_share - MIN_FREE_SHARE) * 4 * hull.cell, -np.inf)
    field = np.maximum(hull.field, edge)
    field[carved] = np.maximum(field[carved], 0.2 * hull.cell)
    remaining = replace(hull, occupancy=field < 0, field=field.astype(np.float32))
    return CarvedHull(remaining, float(carved.sum() / solid.sum()), regions, unsupported, int(violating.sum()))


def _hard_cells(solid: NDArray[np.bool_], softness: Floats) -> NDArray[np.bool_]:
    """Cells (n, n, n) at most HARD_DEPTH below a hard part of the hull's surface."""
    return np.asarray((softness < SOFT) & (ndimage.distance_transform_edt(ndimage.binary_erosion(solid)) < HARD_DEPTH))


def _carvable_regions(
    free: NDArray[np.bool_], solid: NDArray[np.bool_], surface_share: Floats, softness: Floats, limits: Sequence[RegionLimits]
) -> tuple[NDArray[np.int32], NDArray[np.bool_], int]:
    """Regions of `free` cells connected to the outside: labels (n, n, n), which labels (k,) keep to some of the `limits`, and how many
    keep to none."""
    outside, shell = ~solid, solid & ~ndimage.binary_erosion(solid)
    # A tunnel one cell wide is a leak, not a concavity.
    free = free & ndimage.binary_opening(free | outside, ndimage.generate_binary_structure(3, 1))
    label, _ = ndimage.label(free | outside)
    reached = free & np.isin(label, np.unique(label[outside]))
    label, count = ndimage.label(reached)
    keep, refused = np.zeros(count + 1, bool), 0
    for number, box in enumerate(ndimage.find_objects(label), 1):
        wider = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in box)
        region = label[wider] == number
        if region.sum() < MIN_REGION_CELLS:
            continue
        exposed = ndimage.binary_dilation(region) & solid[wider] & ~reached[wider]
        opening = softness[wider][region & shell[wider]]
        keep[number] = exposed.any() and any(
            surface_share[wider][exposed].mean() >= limit.surface
            and (opening > SOFT).sum() >= limit.soft * len(opening)
            and len(opening) >= limit.opening * region.sum() ** (2 / 3)
            for limit in limits
        )
        refused += not keep[number]
    return label, keep, refused


def _grow(carved: NDArray[np.bool_], free_share: Floats, hull: Hull, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """Cells (n, n, n) beside the carved ones that are free under the weaker prior; none of regions that violate silhouettes."""
    solid = hull.field < 0
    free = solid & ~carved & (free_share > MIN_JOINING_FREE_SHARE)
    free &= ndimage.binary_opening(free | carved | ~solid, ndimage.generate_binary_structure(3, 1))
    label, count = ndimage.label(free)
    keep = np.zeros(count + 1, bool)
    keep[np.unique(label[ndimage.binary_dilation(carved) & free])] = True
    keep[0] = False
    keep &= ~_violates_silhouettes(label, keep, solid & ~carved, hull, cameras)
    return np.asarray(keep[label])


def _violates_silhouettes(
    label: NDArray[np.int32], keep: NDArray[np.bool_], solid: NDArray[np.bool_], hull: Hull, cameras: Sequence[Camera]
) -> NDArray[np.bool_]:
    """Which regions (k,) of those in `keep` (k,) violate silhouettes when carved from `solid` (n, n, n); `label` (n, n, n) is the region of
    each cell."""
    carved = keep[label]
    cells = np.argwhere(carved)
    empty = count_empty_rays(cells, solid & ~carved, hull, cameras) >= MIN_EMPTY_RAYS
    region = label[tuple(cells.T)]
    violating = np.bincount(region, empty, len(keep))
    return np.asarray(violating > MAX_EMPTY_SHARE * np.bincount(region, minlength=len(keep)))
