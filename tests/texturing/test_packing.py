"""Placement of charts: what is passed over could not hold them."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.texturing import packing
from gsbake.texturing.packing import _bits, _fill, _longest_run, _place, pack

CELLS = 96


def first_free(taken: np.ndarray, chart: np.ndarray, first: int, limit: int) -> tuple[int, int]:
    """The lowest, then leftmost place by trying all."""
    height, width = chart.shape
    for y in range(first, min(limit, CELLS - height + 1)):
        for x in range(CELLS - width + 1):
            if not (taken[y : y + height, x : x + width] & chart).any():
                return x, y
    return -1, -1


@pytest.mark.parametrize("seed", range(4))
def test_charts_lie_where_trying_all_places_puts_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    taken = np.zeros((CELLS, CELLS), bool)
    occupied, longest = np.zeros((CELLS, CELLS // 64 + 3), np.uint64), np.full(CELLS, CELLS)
    placed = 0
    for _ in range(60):
        height, width = rng.integers(1, 40, 2)
        chart = rng.random((height, width)) < rng.choice([0.3, 0.8, 1.0])
        chart[rng.integers(height), rng.integers(width)] = True
        rows, first, limit = _bits(chart.astype(np.uint8)), int(rng.integers(0, 5)), int(rng.integers(20, CELLS + 1))
        x, y = _place(occupied, longest, rows, width, CELLS, first, limit)
        assert (x, y) == first_free(taken, chart, first, limit)
        if x >= 0:
            _fill(occupied, longest, rows, x, y, CELLS)
            taken[y : y + height, x : x + width] |= chart
            placed += 1
    assert placed > 20
    assert [_longest_run(row, CELLS, 0) for row in _bits(taken.astype(np.uint8))] == longest.tolist()


@pytest.mark.parametrize("many", [2000, 100])
def test_many_equal_charts_do_not_overlap_and_fill_the_square(monkeypatch: pytest.MonkeyPatch, many: int) -> None:
    """Equal bitmaps, for which searches start where the one before ended; and boxes on shelves."""
    monkeypatch.setattr(packing, "MANY_CHARTS", many)
    side = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    count = 150
    uv = np.concatenate([side * (1.0 if k % 3 else 0.5) for k in range(count)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(count)])
    packed = pack(uv, faces, np.repeat(np.arange(count), 2), 256, 2)
    corners = packed.uv.reshape(count, 4, 2)
    low, high = corners.min(1), corners.max(1)
    assert low.min() >= 1 and high.max() <= 255
    for k in range(count):
        apart = ((low[k] >= high + 2 - 1e-6) | (high[k] <= low - 2 + 1e-6)).any(1)
        assert apart.sum() == count - 1
    assert ((high - low).prod(1).sum()) > 0.5 * 256**2
