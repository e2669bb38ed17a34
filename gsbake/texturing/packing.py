"""Chart packing into one square texture of an exact size.

Charts are drawn conservatively on a coarse grid, grown by half the padding, and placed one by one, largest first, at the lowest free
position of the square in the best of four right-angle rotations. The scale is then searched so that all charts just fit. Rotations only:
a mirrored chart would turn the handedness of its tangent frame. Occupied cells are bits of 64-bit words, so that a whole row of a chart
is tested at once. More than `MANY_CHARTS` would take minutes so, and are mostly padding anyway: their boxes stand on shelves.

Lévy et al., *Least squares conformal maps for automatic texture atlas generation*, SIGGRAPH 2002 (packing of chart outlines on a bitmap).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Cells along the square in the first and the last search for the scale. Finer cells pack tighter and take longer: 126 charts on 1024
#: texels fill 0.58 of the square with 128 cells (0.12 s), 0.61 with 256 (0.4 s), 0.63 with 512 (1.1 s).
CELLS = (256, 512)
#: Share of the square that charts fill when the search for the scale starts.
FIRST_FILL = 0.6
#: The search for the scale ends when it is known to this factor.
SCALE_STEP = 1.012
#: Charts above which boxes are packed instead of outlines: 8 400 charts take 35 s by their outlines.
MANY_CHARTS = 2000
#: Smallest scale of boxes that is tried, as a share of that at which the longest fills the square.
MIN_SCALE = 1e-6


@dataclass(frozen=True)
class Packed:
    """Packed charts: `uv` (v, 2) texel coordinates in a square of `size`, and `scale` in texels per input unit."""

    uv: Floats
    scale: float


@kernel("f8[:, ::1], i8[:, ::1], f8, f8, u1[:, ::1]", error_model="numpy")
def _draw(uv: Floats, faces: Ints, cell: float, reach: float, out: NDArray[np.uint8]) -> None:
    """Mark cells of `out` (h, w) whose square, grown by `reach` (in uv units), overlaps a triangle; uv starts at (reach, reach)."""
    height, width = out.shape
    for f in range(faces.shape[0]):
        x0, y0 = uv[faces[f, 0], 0], uv[faces[f, 0], 1]
        x1, y1 = uv[faces[f, 1], 0], uv[faces[f, 1], 1]
        x2, y2 = uv[faces[f, 2], 0], uv[faces[f, 2], 1]
        low_i = max(0, int(np.floor((min(x0, x1, x2) - reach) / cell)))
        high_i = min(width - 1, int(np.floor((max(x0, x1, x2) + reach) / cell)))
        low_j = max(0, int(np.floor((min(y0, y1, y2) - reach) / cell)))
        high_j = min(height - 1, int(np.floor((max(y0, y1, y2) + reach) / cell)))
        sign = 1.0 if (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0) >= 0 else -1.0
        half = 0.5 * cell
        for j in range(low_j, high_j + 1):
            for i in range(low_i, high_i + 1):
                if out[j, i]:
                    continue
                cx, cy = (i + 0.5) * cell, (j + 0.5) * cell
                apart = False
                for e in range(3):
                    ax, ay = (x0, y0) if e == 0 else ((x1, y1) if e == 1 else (x2, y2))
                    bx, by = (x1, y1) if e == 0 else ((x2, y2) if e == 1 else (x0, y0))
                    nx, ny = sign * (by - ay), -sign * (bx - ax)  # outward
                    length = np.sqrt(nx * nx + ny * ny)
                    outside = nx * (cx - ax) + ny * (cy - ay)
                    if outside > half * (abs(nx) + abs(ny)) + reach * length:
                        apart = True
                        break
                if not apart:
                    out[j, i] = 1


@kernel("u1[:, ::1]")
def _bits(bitmap: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Rows of a 0/1 bitmap (h, w) as 64-bit words (h, ceil(w / 64)), lowest bit first."""
    height, width = bitmap.shape
    out = np.zeros((height, (width + 63) // 64), np.uint64)
    for j in range(height):
        for i in range(width):
            if bitmap[j, i]:
                out[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
    return out


@numba.njit(cache=True)
def _last_overlap(occupied: NDArray[np.uint64], row: NDArray[np.uint64], y: int, x: int) -> int:
    """The rightmost cell of row y that is occupied and covered by a chart row at x; -1: none."""
    word, shift = x >> 6, np.uint64(x & 63)
    back = np.uint64(64) - shift
    for k in range(row.shape[0], -1, -1):
        moved = np.uint64(0)
        if k < row.shape[0]:
            moved = row[k] << shift
        if k > 0 and shift:
            moved |= row[k - 1] >> back
        both = moved & occupied[y, word + k]
        if both:
            bit = 63
            while not (both >> np.uint64(bit)) & np.uint64(1):
                bit -= 1
            return ((word + k) << 6) + bit
    return -1


@numba.njit(cache=True)
def _longest_run(row: NDArray[np.uint64], cells: int, value: int) -> int:
    """Length of the longest run of bits `value` (0 or 1) among the first `cells` of a row."""
    longest = run = 0
    for x in range(cells):
        if int((row[x >> 6] >> np.uint64(x & 63)) & np.uint64(1)) == value:
            run += 1
            longest = max(longest, run)
        else:
            run = 0
    return longest


@kernel("u8[:, ::1], i8[::1], u8[:, ::1], i8, i8, i8, i8")
def _place(
    occupied: NDArray[np.uint64], longest_free: NDArray[np.int64], rows: NDArray[np.uint64], width: int, cells: int, first: int, limit: int
) -> tuple[int, int]:
    """Lowest (then leftmost) free position (x, y) with first ≤ y < limit, or (-1, -1).

    `occupied` (cells, words + 1) has one extra word per row for the bits shifted past the end, `longest_free` (cells,) the longest run of
    free cells of each row. Passed over is what cannot fit: heights at which a row has no free run as long as the chart's, and where a row
    of the chart overlaps an occupied cell, all positions at which the same run of the row's cells would still cover that cell.
    """
    height = rows.shape[0]
    needed = np.empty(height, np.int64)
    for r in range(height):
        needed[r] = _longest_run(rows[r], width, 1)
    for y in range(first, min(limit, cells - height + 1)):
        possible = True
        for r in range(height):
            if needed[r] > longest_free[y + r]:
                possible = False
                break
        x = 0 if possible else cells
        while x <= cells - width:
            free = True
            # The middle row of a chart is usually the widest: test it first.
            for k in range(height):
                r = (height // 2 + k) % height
                last = _last_overlap(occupied, rows[r], y + r, x)
                if last >= 0:
                    start = last - x
                    while start > 0 and (rows[r, (start - 1) >> 6] >> np.uint64((start - 1) & 63)) & np.uint64(1):
                        start -= 1
                    x = last - start + 1
                    free = False
                    break
            if free:
                return x, y
    return -1, -1


@kernel("u8[:, ::1], i8[::1], u8[:, ::1], i8, i8, i8")
def _fill(occupied: NDArray[np.uint64], longest_free: NDArray[np.int64], rows: NDArray[np.uint64], x: int, y: int, cells: int) -> None:
    """Mark a chart placed at (x, y)."""
    word, shift = x >> 6, np.uint64(x & 63)
    for r in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            occupied[y + r, word + k] |= rows[r, k] << shift
            if shift:
                occupied[y + r, word + k + 1] |= rows[r, k] >> (np.uint64(64) - shift)
        longest_free[y + r] = _longest_run(occupied[y + r], cells, 0)


def _fit(charts: list[tuple[Floats, Ints]], order: Ints, scale: float, size: int, padding: float, cells: int) -> list[Floats] | None:
    """Texel coordinates of every chart at `scale`, or None when they do not all fit."""
    cell = size / cells
    reach = padding / 2
    occupied, longest_free = np.zeros((cells, cells // 64 + 3), np.uint64), np.full(cells, cells)
    placed: list[Floats] = [np.zeros((0, 2))] * len(charts)
    nothing_below: dict[tuple[int, bytes], int] = {}  # rows below which there is no place for a bitmap: cells are only ever occupied
    for c in order:
        uv, faces = charts[c]
        uv = uv * scale
        uv = uv - uv.min(0) + reach
        box = np.maximum(1, np.ceil((uv.max(0) + reach) / cell - 1e-9)).astype(int)
        if box.max() > cells:
            return None
        bitmap = np.zeros((box[1], box[0]), np.uint8)
        _draw(uv, faces, cell, reach, bitmap)
        best = (cells + 1, 0, 0, 0)  # top edge, x, y, rotation
        for turn in range(4):
            turned = np.ascontiguousarray(np.rot90(bitmap, turn))
            height, width = turned.shape
            limit, key = max(0, best[0] - height), (height, turned.tobytes())
            first = nothing_below.get(key, 0)
            x, y = _place(occupied, longest_free, _bits(turned), width, cells, first, limit)
            nothing_below[key] = y if x >= 0 else max(first, limit)
            if x >= 0:
                best = (y + height, x, y, turn)
        top, x, y, turn = best
        if top > cells:
            return None
        _fill(occupied, longest_free, _bits(np.ascontiguousarray(np.rot90(bitmap, turn))), x, y, cells)
        width_uv, height_uv = bitmap.shape[1] * cell, bitmap.shape[0] * cell
        u, v = uv[:, 0], uv[:, 1]
        # np.rot90 turns rows (here: v) and columns (u) as these maps do; all four are proper rotations.
        moved = ((u, v), (v, width_uv - u), (width_uv - u, height_uv - v), (height_uv - v, u))[turn]
        placed[c] = np.stack(moved, 1) + np.array([x, y]) * cell
    return placed


def _search(
    charts: list[tuple[Floats, Ints]], order: Ints, start: float, step: float, size: int, padding: float, cells: int
) -> tuple[list[Floats], float]:
    """The largest scale found at which all charts fit, walking from `start` by `step`, then halving; and their coordinates there."""
    low, high, scale = 0.0, np.inf, start
    best: list[Floats] | None = None
    for _ in range(60):
        found = _fit(charts, order, scale, size, padding, cells)
        if found is not None:
            low, best = scale, found
        else:
            high = scale
        if best is not None and np.isfinite(high):
            if high / low < SCALE_STEP:
                return best, low
            scale = float(np.sqrt(low * high))
        else:
            scale = scale * step if best is not None else scale / step
            step = min(step**1.3, 2.0)
    raise _does_not_fit(len(charts), size, padding)


def _does_not_fit(charts: int, size: int, padding: float) -> ValueError:
    return ValueError(
        f"{charts} charts with {padding} texels of padding do not fit a texture of {size} texels; raise bake.size, lower mesh.faces "
        "or join the mesh's pieces"
    )


def _stand_on_shelves(boxes: Floats, size: int) -> Floats | None:
    """Lowest corners (n, 2) of boxes (n, 2), the tallest first, from left to right and shelf by shelf; None where they do not fit."""
    ends, heights = np.cumsum(boxes[:, 0]), boxes[:, 1]
    corners, first, y = np.empty_like(boxes), 0, 0.0
    while first < len(boxes):
        start = ends[first] - boxes[first, 0]
        last = int(np.searchsorted(ends, start + size, side="right"))
        if last == first or y + heights[first] > size:
            return None
        corners[first:last, 0], corners[first:last, 1] = ends[first:last] - boxes[first:last, 0] - start, y
        first, y = last, y + heights[first]
    return corners


def _search_on_shelves(charts: list[tuple[Floats, Ints]], extents: Floats, size: int, padding: float) -> tuple[list[Floats], float]:
    """The largest scale found at which the boxes of all charts, of `extents` (n, 2), stand on shelves; the coordinates there, and it.

    Each chart lies on its longer side.
    """
    lying = np.sort(extents, axis=1)[:, ::-1]
    order = np.argsort(-lying[:, 1], kind="stable")
    high = (size - padding) / max(lying.max(), 1e-30)
    low = MIN_SCALE * high
    corners = _stand_on_shelves(low * lying[order] + padding, size)
    if corners is None:
        raise _does_not_fit(len(charts), size, padding)
    while high / low > SCALE_STEP:
        scale = float(np.sqrt(low * high))
        found = _stand_on_shelves(scale * lying[order] + padding, size)
        if found is None:
            high = scale
        else:
            low, corners = scale, found
    placed: list[Floats] = [np.zeros((0, 2))] * len(charts)
    for c, corner in zip(order, corners, strict=True):
        uv = low * (charts[c][0] - charts[c][0].min(0))
        if extents[c, 1] > extents[c, 0]:  # a quarter turn, not a mirroring
            uv = np.stack([uv[:, 1], low * extents[c, 0] - uv[:, 0]], 1)
        placed[c] = uv + corner + padding / 2
    return placed, low


def pack(uv: Floats, faces: Ints, chart: Ints, size: int, padding: float) -> Packed:
    """Pack charts into a square of `size` texels with `padding` texels between them and half of it at the border.

    `uv` (v, 2) in a common unit, `faces` (f, 3), `chart` (f,) chart of each face; no vertex may belong to two charts. Every chart keeps its
    shape and handedness; all get the same scale, the largest found.
    """
    order_faces = np.argsort(chart, kind="stable")
    ends = np.flatnonzero(np.diff(chart[order_faces])) + 1
    charts: list[tuple[Floats, Ints]] = []
    members: list[Ints] = []
    for part in np.split(order_faces, ends):
        used, inverse = np.unique(faces[part], return_inverse=True)
        charts.append((np.ascontiguousarray(uv[used]), np.ascontiguousarray(inverse.reshape(-1, 3), np.int64)))
        members.append(used)
    extents = np.array([np.ptp(c[0], axis=0) for c in charts])
    if len(charts) > MANY_CHARTS:
        best, scale = _search_on_shelves(charts, extents, size, padding)
    else:
        best, scale = _search_outlines(charts, extents, uv[faces], size, padding)
    out = np.zeros_like(uv)
    for used, coordinates in zip(members, best, strict=True):
        out[used] = coordinates
    return Packed(out, scale)


def _search_outlines(
    charts: list[tuple[Floats, Ints]], extents: Floats, corners: Floats, size: int, padding: float
) -> tuple[list[Floats], float]:
    """Texel coordinates of all charts packed by their outlines, and the scale; `corners` (f, 3, 2) of all triangles."""
    order = np.lexsort((np.arange(len(charts)), -extents.max(1)))
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).sum()
    scale = min(size * np.sqrt(FIRST_FILL / max(area, 1e-30)), (size - padding) / max(extents.max(), 1e-30))
    best, scale = _search(charts, order, scale, 1.1, size, padding, min(CELLS[0], size))
    if size > CELLS[0]:
        best, scale = _search(charts, order, scale * 1.02, 1.02, size, padding, min(CELLS[1], size))
    return best, scale
