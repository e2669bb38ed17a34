"""The visual hull opened where matching sees through it.

A hull bulges over every concave place. Stereo confirms few depths there (gloss, no texture, edges close together), yet far more pixels are
matched to a depth that one or two other photos share, and most of those lie behind the bulge. So the hull's cells are put to the vote:
a ray whose depth is farther speaks for air, one whose depth is here for a surface, and what lies behind a depth says nothing
(Hernández, Vogiatzis & Cipolla, *Probabilistic visibility for multi-view stereo*, CVPR 2007, as plain counts). Air that is connected to the
outside is taken away, but only where the surface that this lays bare has votes of its own: mirror images lie behind a glossy surface
too, but mostly at another place for every photo.

Where they do agree (a smooth black handle mirrors the same lamp to many photos), silhouettes tell: every ray through the hull meets the
object, so what is taken must leave something on each (Laurentini, *The visual hull concept*, PAMI 1994, whose hull is the largest such
shape). A real hollow does, a dent in what bulges is missed in the photos that see it from the side.
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
from gsbake.mvs.ncc import FAST

Floats = NDArray[np.float32]

#: Half the depth, in cells, within which a vote is for a surface.
BAND = 0.5
#: Votes are spread over this many cells (standard deviation): those of one cell are few.
SPREAD = 1.0
#: Air: this share of the votes. Nothing being known counts as so many votes for a surface: at least the second, and the third as a share
#: of how many cells that are seen through mostly get, for where most get many, few say little.
AIR, UNKNOWN, UNKNOWN_SHARE = 0.65, 0.3, 0.2
#: Cells under the hull up to which it is opened.
DEEPEST = 6.0
#: Openings of fewer cells are noise, and left closed; of larger ones the new surface must have this share of the votes in the mean.
LEAST_CELLS, BACKED = 8, 0.12
#: A cell bears silhouettes when without the opening so many photos would see through the hull there: masks of single photos err. Openings
#: with more than this share of such cells stay closed: real hollows have up to .03 of them, false ones a tenth to two thirds.
LEAST_SEEN, BEARING = 2, 0.1


@dataclass(frozen=True)
class Opened:
    """The opened hull, the share of the hull's cells taken away, and how many openings were made, for want of backing refused, and refused
    because silhouettes would have got holes."""

    hull: Hull
    share: float
    made: int
    refused: int
    holed: int


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _pixel(x: float, y: float, z: float, p: Any, lens: Any, size: Any) -> tuple[int, int, float]:
    """Column, row and z-depth of a place in a photo, see `_pinholes`; depth 0 where it is behind the camera or outside the frame."""
    here = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
    if not here > 1e-6:
        return 0, 0, 0.0
    across = lens[0] * (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / here + lens[2]
    down = lens[1] * (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / here + lens[3]
    if not (across >= 0 and down >= 0 and across < size[0] and down < size[1]):
        return 0, 0, 0.0
    return int(across), int(down), here


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _count(
    field: Any, lower: Any, cell: float, band: float, depth: Any, starts: Any, sizes: Any, lenses: Any, poses: Any, air: Any, surface: Any
) -> None:
    """Kernel of `count_votes`: all depth maps one after another in `depth`."""
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
                    column, row, here = _pixel(x, y, z, poses[v], lenses[v], sizes[v])
                    if not here > 0:
                        continue
                    there = depth[np.uint64(starts[v] + row * sizes[v, 0] + column)]
                    if not there > 0:
                        continue
                    if there > here + band:
                        air[i, j, k] += np.float32(1)
                    elif there > here - band:
                        surface[i, j, k] += np.float32(1)


@nb.njit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
def _see_through(cells: Any, left: Any, lower: Any, cell: float, sizes: Any, lenses: Any, poses: Any, centres: Any, out: Any) -> None:
    """Kernel of `seen_through`; rays are followed from the cell both ways in steps of half a cell."""
    n0, n1, n2 = left.shape
    for m in range(cells.shape[0]):
        i, j, k = cells[m, 0] + 0.5, cells[m, 1] + 0.5, cells[m, 2] + 0.5
        x, y, z = lower[0] + i * cell, lower[1] + j * cell, lower[2] + k * cell
        for v in range(poses.shape[0]):
            if not _pixel(x, y, z, poses[v], lenses[v], sizes[v])[2] > 0:
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


def seen_through(cells: NDArray[np.int64], left: NDArray[np.bool_], hull: Hull, cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """In how many photos (m,) the ray through a cell of the hull, `cells` (m, 3), meets none of the cells that are `left` (n, n, n)."""
    out = np.zeros(len(cells), np.int64)
    if len(cells) and cameras:
        centres = np.array([c.centre for c in cameras], float)
        _see_through(cells, left, np.asarray(hull.lower, float), float(hull.cell), *_pinholes(cameras), centres, out)
    return out


def _pinholes(cameras: Sequence[Camera]) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Sizes (v, 2) as width, height, lenses (v, 4) as fx, fy, cx, cy and poses (v, 3, 4), world to camera, for kernels."""
    sizes = np.array([(c.width, c.height) for c in cameras], np.int64)
    lenses = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], float)
    return sizes, lenses, np.array([np.concatenate([c.R, c.t[:, None]], 1) for c in cameras], float)


def count_votes(hull: Hull, cameras: Sequence[Camera], depths: Sequence[Floats]) -> tuple[Floats, Floats]:
    """For each cell (n, n, n) in or next to the hull how many depths lie behind it (air) and within half a cell of it (surface).

    `depths` are z-depths (h, w) of the cameras' sizes, 0 = none.
    """
    air, surface = np.zeros(hull.field.shape, np.float32), np.zeros(hull.field.shape, np.float32)
    if not cameras:
        return air, surface
    sizes, lenses, poses = _pinholes(cameras)
    _count(
        hull.field,
        np.asarray(hull.lower, float),
        float(hull.cell),
        BAND * float(hull.cell),
        np.concatenate([np.asarray(d, np.float32).ravel() for d in depths]),
        np.concatenate([[0], np.cumsum([d.size for d in depths])[:-1]]).astype(np.int64),
        sizes,
        lenses,
        poses,
        air,
        surface,
    )
    return air, surface


def open_hull(hull: Hull, cameras: Sequence[Camera], depths: Sequence[Floats]) -> Opened:
    """Take from the hull what `depths` (h, w; 0 = none) of the `cameras` see through.

    The cells at the new surface take their distance from the share of the votes: it lies where air just has AIR of them, which is up to a
    cell before the true one. That is the side to be on: surfels behind the true surface are never seen.
    """
    air, surface = (ndimage.gaussian_filter(v, SPREAD) for v in count_votes(hull, cameras, depths))
    solid = hull.field < 0
    outside = ~solid
    doubted = solid & (air > AIR * (air + surface))
    if not doubted.any():
        return Opened(hull, 0.0, 0, 0, 0)
    total = air + surface + max(UNKNOWN, UNKNOWN_SHARE * float(np.median((air + surface)[doubted])))
    through, backing = air / total, surface / total
    free = solid & (through > AIR) & (hull.field > -DEEPEST * hull.cell)
    # A tunnel of one cell is a leak, not a concave place.
    free &= ndimage.binary_opening(free | outside, ndimage.generate_binary_structure(3, 1))
    label, _ = ndimage.label(free | outside)
    reached = free & np.isin(label, np.unique(label[outside]))
    label, count = ndimage.label(reached)
    keep, refused = np.zeros(count + 1, bool), 0
    for number, box in enumerate(ndimage.find_objects(label), 1):
        wider = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in box)
        piece = label[wider] == number
        if piece.sum() < LEAST_CELLS:
            continue
        bare = ndimage.binary_dilation(piece) & solid[wider] & ~reached[wider]
        keep[number] = bare.any() and backing[wider][bare].mean() >= BACKED
        refused += not keep[number]
    holed = _holed(label, keep, hull, cameras)
    keep &= ~holed
    carved = keep[label]
    if not carved.any() or carved[solid].all():  # nothing seen through, or nothing left
        return Opened(hull, 0.0, 0, refused, int(holed.sum()))
    # Distances in cells follow from how fast the share of air falls across a new surface: by about a quarter a cell.
    edge = np.where(ndimage.binary_dilation(carved), (through - AIR) * 4 * hull.cell, -np.inf)
    field = np.maximum(hull.field, edge)
    field[carved] = np.maximum(field[carved], 0.2 * hull.cell)
    opened = replace(hull, occupancy=field < 0, field=field.astype(np.float32))
    return Opened(opened, float(carved.sum() / solid.sum()), int(keep.sum()), refused, int(holed.sum()))


def _holed(label: NDArray[np.int32], keep: NDArray[np.bool_], hull: Hull, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """Which openings (k,) of those to `keep` (k,) silhouettes speak against; `label` (n, n, n) says which a cell belongs to."""
    taken = keep[label]
    cells = np.argwhere(taken)
    through = seen_through(cells, (hull.field < 0) & ~taken, hull, cameras) >= LEAST_SEEN
    owner = label[tuple(cells.T)]
    bearing = np.bincount(owner, through, len(keep))
    return np.asarray(bearing > BEARING * np.bincount(owner, minlength=len(keep)))
