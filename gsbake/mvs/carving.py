"""Carving of the visual hull by free-space votes of stereo depths.

A visual hull fills every concavity. Few depths there pass the full consistency check (specular or textureless surface, nearby edges), yet
far more pixels have a depth that one or two other photos share, and most of those lie behind the hull's surface. So depths vote on the
hull's cells: a depth behind a cell votes for free space, a depth in the cell for surface, a depth before it does not vote (Hernández,
Vogiatzis & Cipolla, *Probabilistic visibility for multi-view stereo*, CVPR 2007, as plain counts). Free space that is connected to
the outside is carved, but only where the exposed surface has votes of its own: mirror images lie behind a specular surface too, but mostly
at a different location in every photo.

Mirror images that do agree (a smooth black handle reflects the same light to many photos) are detected by silhouettes: every ray through
the hull must still meet the object after carving (Laurentini, *The visual hull concept*, PAMI 1994: the hull is the largest such
shape). Carving a concavity keeps this property; carving a convex part leaves empty rays in photos from the side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.mvs.ncc import FASTMATH

Floats = NDArray[np.float32]

#: A depth votes for surface within this many cells of the cell's centre.
SURFACE_BAND = 0.5
#: Gaussian smoothing of the votes in cells (standard deviation): single cells get few votes.
VOTE_SIGMA = 1.0
#: Free space has this share of the votes. The prior adds votes for surface: at least the second, or the third as a share of the median
#: number of votes per free cell, whichever is more.
MIN_FREE_SHARE, PRIOR_VOTES, PRIOR_VOTE_SHARE = 0.65, 0.3, 0.2
#: Greatest carving depth below the hull's surface in cells.
MAX_CARVING_DEPTH = 6.0
#: The same share for cells that join a carved region (hysteresis: Canny, *A computational approach to edge detection*, PAMI 1986).
GROWTH_PRIOR_VOTE_SHARE = 0.1
#: Carved regions have at least this many cells (fewer are noise), and at least this mean share of surface votes on the exposed surface.
MIN_REGION_CELLS, MIN_SURFACE_SHARE = 8, 0.12
#: A cell violates silhouettes when carving leaves this many photos with an empty ray through it (single masks may be wrong). Regions
#: with more than this share of such cells are rejected: true concavities have up to .03 of them, false ones .1 to .67.
MIN_EMPTY_RAYS, MAX_EMPTY_SHARE = 2, 0.1


@dataclass(frozen=True)
class CarvedHull:
    """The carved `hull`, the `share` of cells carved, and the numbers of regions carved, rejected for lack of surface votes, and rejected
    because they violate silhouettes."""

    hull: Hull
    share: float
    carved_regions: int
    unsupported_regions: int
    silhouette_violations: int


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def _project(x: float, y: float, z: float, p: Any, intrinsics: Any, size: Any) -> tuple[int, int, float]:
    """Column, row and z-depth of a point in a photo (see `_camera_arrays`); depth 0 behind the camera or outside the frame."""
    here = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
    if not here > 1e-6:
        return 0, 0, 0.0
    across = intrinsics[0] * (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / here + intrinsics[2]
    down = intrinsics[1] * (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / here + intrinsics[3]
    if not (across >= 0 and down >= 0 and across < size[0] and down < size[1]):
        return 0, 0, 0.0
    return int(across), int(down), here


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
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
                    column, row, here = _project(x, y, z, poses[v], intrinsics[v], sizes[v])
                    if not here > 0:
                        continue
                    there = depth[np.uint64(starts[v] + row * sizes[v, 0] + column)]
                    if not there > 0:
                        continue
                    if there > here + band:
                        free[i, j, k] += np.float32(1)
                    elif there > here - band:
                        surface[i, j, k] += np.float32(1)


@nb.njit(fastmath=FASTMATH, error_model="numpy", nogil=True, cache=True)
def _count_empty_rays(
    cells: Any, left: Any, lower: Any, cell: float, sizes: Any, intrinsics: Any, poses: Any, centres: Any, out: Any
) -> None:
    """Kernel of `count_empty_rays`; rays are marched from the cell in both directions in steps of half a cell."""
    n0, n1, n2 = left.shape
    for m in range(cells.shape[0]):
        i, j, k = cells[m, 0] + 0.5, cells[m, 1] + 0.5, cells[m, 2] + 0.5
        x, y, z = lower[0] + i * cell, lower[1] + j * cell, lower[2] + k * cell
        for v in range(poses.shape[0]):
            if not _project(x, y, z, poses[v], intrinsics[v], sizes[v])[2] > 0:
                continue
            dx, dy, dz = x - centres[v, 0], y - centres[v, 1], z - centres[v, 2]
            step = 0.5 / np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * step, dy * step, dz * step
            met = False
            for _ in range(2):
                a, b, c = i + dx, j + dy, k + dz
                while not met and a >= 0 and b >= 0 and c >= 0 and a < n0 and b < n1 and c < n2:
                    met = left[np.int64(a), np.int64(b), np.int64(c)]
                    a, b, c = a + dx, b + dy, c + dz
                dx, dy, dz = -dx, -dy, -dz
            if not met:
                out[m] += 1


def count_empty_rays(cells: NDArray[np.int64], left: NDArray[np.bool_], hull: Hull, cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """Number of photos (m,) whose ray through a cell of the hull, `cells` (m, 3), meets none of the cells `left` (n, n, n)."""
    out = np.zeros(len(cells), np.int64)
    if len(cells) and cameras:
        centres = np.array([c.centre for c in cameras], float)
        _count_empty_rays(cells, left, np.asarray(hull.lower, float), float(hull.cell), *_camera_arrays(cameras), centres, out)
    return out


def _camera_arrays(cameras: Sequence[Camera]) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Sizes (v, 2) as width, height, intrinsics (v, 4) as fx, fy, cx, cy and poses (v, 3, 4), world → camera, for the kernels."""
    sizes = np.array([(c.width, c.height) for c in cameras], np.int64)
    intrinsics = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], float)
    return sizes, intrinsics, np.array([np.concatenate([c.R, c.t[:, None]], 1) for c in cameras], float)


def count_votes(hull: Hull, cameras: Sequence[Camera], depths: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Votes (n, n, n) for free space (depth behind the cell) and surface (depth within half a cell), for cells in or next to the hull.

    `depths` are z-depths (h, w) of the cameras' sizes, 0 = none.
    """
    free, surface = np.zeros(hull.field.shape, np.float32), np.zeros(hull.field.shape, np.float32)
    if not cameras:
        return free, surface
    sizes, intrinsics, poses = _camera_arrays(cameras)
    _count_votes(
        hull.field,
        np.asarray(hull.lower, float),
        float(hull.cell),
        SURFACE_BAND * float(hull.cell),
        np.concatenate([np.asarray(d, np.float32).ravel() for d in depths]),
        np.concatenate([[0], np.cumsum([d.size for d in depths])[:-1]]).astype(np.int64),
        sizes,
        intrinsics,
        poses,
        free,
        surface,
    )
    return free, surface


def carve_hull(hull: Hull, cameras: Sequence[Camera], depths: Sequence[Floats]) -> CarvedHull:
    """Carve from the hull what the `depths` (h, w; 0 = none) of the `cameras` see through.

    The signed distance of cells at the new surface follows from the share of free-space votes: the surface lies where that share is
    MIN_FREE_SHARE, up to a cell before the true one. This is the safe side: surfels behind the true surface are occluded.
    """
    votes, surface = (ndimage.gaussian_filter(v, VOTE_SIGMA) for v in count_votes(hull, cameras, depths))
    solid = hull.field < 0
    likely_free = solid & (votes > MIN_FREE_SHARE * (votes + surface))
    if not likely_free.any():
        return CarvedHull(hull, 0.0, 0, 0, 0)
    typical = float(np.median((votes + surface)[likely_free]))
    total = votes + surface + max(PRIOR_VOTES, PRIOR_VOTE_SHARE * typical)
    free_share = votes / total
    label, keep, unsupported = _carvable_regions(hull, free_share, surface / total)
    violating = _violates_silhouettes(label, keep, solid, hull, cameras)
    keep &= ~violating
    carved = keep[label]
    if carved.any():
        weaker = votes / (votes + surface + max(PRIOR_VOTES, GROWTH_PRIOR_VOTE_SHARE * typical))
        grown = _grow(carved, weaker, hull, cameras)
        free_share, carved = np.where(grown, weaker, free_share), carved | grown
    if not carved.any() or carved[solid].all():  # nothing to carve, or nothing would be left
        return CarvedHull(hull, 0.0, 0, unsupported, int(violating.sum()))
    # The share of free-space votes falls by about a quarter per cell across a new surface.
    edge = np.where(ndimage.binary_dilation(carved), (free_share - MIN_FREE_SHARE) * 4 * hull.cell, -np.inf)
    field = np.maximum(hull.field, edge)
    field[carved] = np.maximum(field[carved], 0.2 * hull.cell)
    remaining = replace(hull, occupancy=field < 0, field=field.astype(np.float32))
    return CarvedHull(remaining, float(carved.sum() / solid.sum()), int(keep.sum()), unsupported, int(violating.sum()))


def _carvable_regions(hull: Hull, free_share: Floats, surface_share: Floats) -> tuple[NDArray[np.int32], NDArray[np.bool_], int]:
    """Free regions connected to the outside: labels (n, n, n), which labels (k,) have a supported surface, and how many have none."""
    solid = hull.field < 0
    outside = ~solid
    free = solid & (free_share > MIN_FREE_SHARE) & (hull.field > -MAX_CARVING_DEPTH * hull.cell)
    # A tunnel one cell wide is a leak, not a concavity.
    free &= ndimage.binary_opening(free | outside, ndimage.generate_binary_structure(3, 1))
    label, _ = ndimage.label(free | outside)
    reached = free & np.isin(label, np.unique(label[outside]))
    label, count = ndimage.label(reached)
    supported, unsupported = np.zeros(count + 1, bool), 0
    for number, box in enumerate(ndimage.find_objects(label), 1):
        wider = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in box)
        region = label[wider] == number
        if region.sum() < MIN_REGION_CELLS:
            continue
        exposed = ndimage.binary_dilation(region) & solid[wider] & ~reached[wider]
        supported[number] = exposed.any() and surface_share[wider][exposed].mean() >= MIN_SURFACE_SHARE
        unsupported += not supported[number]
    return label, supported, unsupported


def _grow(carved: NDArray[np.bool_], free_share: Floats, hull: Hull, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """Cells (n, n, n) beside the carved ones that are free under the weaker prior; none of regions that violate silhouettes."""
    solid = hull.field < 0
    free = solid & ~carved & (free_share > MIN_FREE_SHARE)
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
