"""The vector operations of the kernels against numpy, lane by lane."""

from __future__ import annotations

import numpy as np
from numba import njit

from gsbake.surfels.raster.blocks import BLOCKS_ACROSS, BLOCKS_DOWN, TILE, pack, unpack
from gsbake.surfels.raster.lanes import (
    EXP2_COEFFICIENTS,
    LANES,
    any_lane,
    broadcast,
    exp2,
    lane_column,
    lane_row,
    load,
    log,
    prefetch,
    select,
    sqrt,
    store,
    sum_lanes,
)


@njit(error_model="numpy")
def _power(x, c, out):  # type: ignore[no-untyped-def]
    for i in range(0, x.shape[0], LANES):
        at = np.uint64(i)
        y = exp2(load(x, at), broadcast(c[0]), broadcast(c[1]), broadcast(c[2]), broadcast(c[3]), broadcast(c[4]), broadcast(c[5]))
        store(out, at, y)


@njit(error_model="numpy")
def _log_and_sqrt(x, logarithms, roots):  # type: ignore[no-untyped-def]
    for i in range(0, x.shape[0], LANES):
        at = np.uint64(i)
        store(logarithms, at, log(load(x, at)))
        store(roots, at, sqrt(load(x, at)))


@njit(error_model="numpy")
def _operations(a, b, f, out):  # type: ignore[no-untyped-def]
    zero, n = np.uint64(0), np.uint64(LANES)
    x, y = load(a, zero), load(b, zero)
    prefetch(a.reshape(1, LANES), zero, 0)
    store(out, n * np.uint64(0), x + y * f)
    store(out, n * np.uint64(1), (f - x) / y)
    store(out, n * np.uint64(2), select((x < y) & (x > f), x, f))
    store(out, n * np.uint64(3), select((x <= y) & (y >= x), lane_column(), lane_row()))
    return sum_lanes(x), any_lane(x > y), any_lane(x > np.float32(1e9))


def test_log_and_sqrt() -> None:
    near = 1 + np.linspace(-1e-3, 1e-3, 800)
    x = np.concatenate([np.geomspace(1.2e-38, 3e38, 8000), near, [1.0, 2.0, 0.5, 0.7071, 0.7072, 1.4142, 1.4143, 4.0]]).astype(np.float32)
    logarithms, roots = np.empty_like(x), np.empty_like(x)
    _log_and_sqrt(x, logarithms, roots)
    exact = np.log(x.astype(np.float64))
    assert (np.abs(logarithms - exact) <= np.maximum(3e-7 * np.abs(exact), 1e-8)).all()
    assert np.array_equal(roots, np.sqrt(x)) and logarithms[x == 1].tolist() == [0.0] * int((x == 1).sum())


def test_power_of_two() -> None:
    x = np.linspace(-20, 5, 8000, dtype=np.float32)
    out = np.empty_like(x)
    _power(x, np.array(EXP2_COEFFICIENTS, np.float32), out)
    exact = np.exp2(x.astype(np.float64))
    assert np.abs(out / exact - 1).max() < 3e-7
    assert (out[x == np.round(x)] == exact[x == np.round(x)]).all()


def test_operations() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, LANES)).astype(np.float32)
    f = np.float32(0.25)
    out = np.empty((4, LANES), np.float32)
    assert (a > b).any()
    sum_, greater, huge = _operations(a, b, f, out.reshape(-1))
    assert np.allclose(out[0], a + b * f) and np.allclose(out[1], (f - a) / b)
    assert np.array_equal(out[2], np.where((a < b) & (a > f), a, f))
    column, row = np.arange(LANES) % 4, np.arange(LANES) // 4
    assert np.array_equal(out[3], np.where(a <= b, column, row))
    assert np.isclose(sum_, a.sum()) and greater and not huge


def test_a_comparison_with_nan_is_false() -> None:
    a, out = np.full(LANES, np.nan, np.float32), np.empty((4, LANES), np.float32)
    _, greater, _ = _operations(a, np.ones(LANES, np.float32), np.float32(2), out.reshape(-1))
    assert not greater and (out[2] == 2).all()


def test_tiles_go_to_blocks_and_back() -> None:
    """Whole tiles, and tiles cut by the frame to any size."""
    width, height, blocks = 40, 36, BLOCKS_ACROSS * BLOCKS_DOWN
    image = np.arange(width * height, dtype=np.float32)
    for cols, rows in ((TILE, TILE), (5, 7), (TILE, 3), (1, TILE)):
        s, copy = np.full(blocks * LANES * 2, -1, np.float32), np.full_like(image, -1)
        u = [np.uint64(v) for v in (width, LANES, 2 * LANES, cols, rows, 3 * width + 2)]
        pack(image, u[5], u[0], s, u[1], u[2], u[3], u[4])
        unpack(s, u[1], u[2], copy, u[5], u[0], u[3], u[4])
        want = np.full_like(image, -1).reshape(height, width)
        want[3 : 3 + rows, 2 : 2 + cols] = image.reshape(height, width)[3 : 3 + rows, 2 : 2 + cols]
        assert np.array_equal(copy.reshape(height, width), want)
        assert (s.reshape(blocks, 2, LANES)[:, 0] == -1).all()
