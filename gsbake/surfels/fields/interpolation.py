"""Multilinear interpolation of the feature tables of `levels` with its Jacobian, and the adjoint of both (Numba).

The Jacobian is an output of its own, linear in the table, so that losses of ∇f need no second derivative. Points get the gradient of the
features only: the curvature terms of a Jacobian's loss are left out. The twin is `interpolation_reference`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsbake.kernels.threads import run_chunks
from gsbake.surfels.fields.interpolation_reference import interpolate_reference
from gsbake.surfels.fields.levels import CORNERS, DENSE, EDGE, HASHED, PRIMES, Levels
from gsbake.surfels.raster.blocks import JIT

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_PRIME_Y, _PRIME_Z, _WRAP = np.uint64(PRIMES[0]), np.uint64(PRIMES[1]), np.uint64(0xFFFFFFFF)


@njit(**JIT)
def _row(numbers, index, i, j, k):  # type: ignore[no-untyped-def]
    """Row of corner (i, j, k) of the level described by `numbers`; -1 where there is none."""
    mode, start = numbers[0], numbers[4]
    if mode == DENSE:
        return start + (i * numbers[2] + j) * numbers[3] + k
    if mode == HASHED:
        mixed = (np.uint64(i) ^ (np.uint64(j) * _PRIME_Y & _WRAP) ^ (np.uint64(k) * _PRIME_Z & _WRAP)) & _WRAP
        return start + np.int64(mixed % np.uint64(numbers[5]))
    if mode == CORNERS:
        found = np.int64(index[numbers[6] + (i * numbers[8] + j) * numbers[9] + k])
        return start + found if found >= 0 else np.int64(-1)
    block = np.int64(index[numbers[6] + ((i // EDGE) * numbers[8] + j // EDGE) * numbers[9] + k // EDGE])
    if block < 0:
        return np.int64(-1)
    return start + ((block * EDGE + i % EDGE) * EDGE + j % EDGE) * EDGE + k % EDGE


@njit(**JIT)
def _cell(value, size):  # type: ignore[no-untyped-def]
    """Lower corner and fraction along one axis of a coordinate in cells, held to the lattice; the last is whether it was held."""
    if size < 2:
        return np.int64(0), _ZERO, _ZERO
    top = np.float32(size - 1)
    if not (value >= _ZERO and value <= top):  # positive form: NaN is held too
        return (np.int64(size - 2), _ONE, _ZERO) if value > top else (np.int64(0), _ZERO, _ZERO)
    base = min(np.int64(value), np.int64(size - 2))
    return base, value - np.float32(base), _ONE


@njit(**JIT)
def _forward(lo, hi, points, lower, numbers, scale, index, table, out, jacobian):  # type: ignore[no-untyped-def]
    levels, dims = numbers.shape[0], table.shape[1]
    for p in range(lo, hi):
        for m in range(levels):
            i, x, sx = _cell((points[p, 0] - lower[0]) * scale[m, 0], numbers[m, 1])
            j, y, sy = _cell((points[p, 1] - lower[1]) * scale[m, 1], numbers[m, 2])
            k, z, sz = _cell((points[p, 2] - lower[2]) * scale[m, 2], numbers[m, 3])
            dx, dy, dz = sx * scale[m, 0], sy * scale[m, 1], sz * scale[m, 2]
            at = m * dims
            for d in range(dims):
                out[p, at + d] = _ZERO
                jacobian[p, 0, at + d] = jacobian[p, 1, at + d] = jacobian[p, 2, at + d] = _ZERO
            for corner in range(8):
                a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                if (a and numbers[m, 1] < 2) or (b and numbers[m, 2] < 2) or (c and numbers[m, 3] < 2):
                    continue
                row = _row(numbers[m], index, i + a, j + b, k + c)
                if row < 0:
                    continue
                wx, wy, wz = (x if a else _ONE - x), (y if b else _ONE - y), (z if c else _ONE - z)
                gx, gy, gz = (dx if a else -dx) * wy * wz, (dy if b else -dy) * wx * wz, (dz if c else -dz) * wx * wy
                w = wx * wy * wz
                for d in range(dims):
                    v = table[row, d]
                    out[p, at + d] += w * v
                    jacobian[p, 0, at + d] += gx * v
                    jacobian[p, 1, at + d] += gy * v
                    jacobian[p, 2, at + d] += gz * v


@njit(**JIT)
def _backward(lo, hi, points, lower, numbers, scale, index, g_out, g_jacobian, g_table):  # type: ignore[no-untyped-def]
    """Gradients to the table, of the levels lo..hi: each has rows of its own, so threads do not meet and the order is fixed."""
    dims = g_table.shape[1]
    for m in range(lo, hi):
        at = m * dims
        for p in range(points.shape[0]):
            i, x, sx = _cell((points[p, 0] - lower[0]) * scale[m, 0], numbers[m, 1])
            j, y, sy = _cell((points[p, 1] - lower[1]) * scale[m, 1], numbers[m, 2])
            k, z, sz = _cell((points[p, 2] - lower[2]) * scale[m, 2], numbers[m, 3])
            dx, dy, dz = sx * scale[m, 0], sy * scale[m, 1], sz * scale[m, 2]
            for corner in range(8):
                a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                if (a and numbers[m, 1] < 2) or (b and numbers[m, 2] < 2) or (c and numbers[m, 3] < 2):
                    continue
                row = _row(numbers[m], index, i + a, j + b, k + c)
                if row < 0:
                    continue
                wx, wy, wz = (x if a else _ONE - x), (y if b else _ONE - y), (z if c else _ONE - z)
                gx, gy, gz = (dx if a else -dx) * wy * wz, (dy if b else -dy) * wx * wz, (dz if c else -dz) * wx * wy
                w = wx * wy * wz
                for d in range(dims):
                    f = at + d
                    g_table[row, d] += w * g_out[p, f] + gx * g_jacobian[p, 0, f] + gy * g_jacobian[p, 1, f] + gz * g_jacobian[p, 2, f]


def _array(x: Tensor) -> Any:
    return x.detach().contiguous().numpy()


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, levels: Levels) -> tuple[Tensor, Tensor]:
        count = len(levels.levels) * table.shape[1]
        out, jacobian = torch.empty(len(points), count), torch.empty(len(points), 3, count)
        args = _array(points), levels.lower, levels.numbers, levels.scale, levels.index, _array(table), out.numpy(), jacobian.numpy()
        run_chunks(lambda lo, hi: _forward(lo, hi, *args), len(points), 4, 1024)
        ctx.save_for_backward(points, jacobian)
        ctx.levels, ctx.shape = levels, table.shape
        return out, jacobian

    @staticmethod
    def backward(ctx: Any, g_out: Tensor, g_jacobian: Tensor) -> Any:
        points, jacobian = ctx.saved_tensors
        levels, g_table = ctx.levels, None
        if ctx.needs_input_grad[1]:
            g_table = torch.zeros(ctx.shape)
            args = levels.lower, levels.numbers, levels.scale, levels.index, _array(g_out), _array(g_jacobian), g_table.numpy()
            array = _array(points)
            run_chunks(lambda lo, hi: _backward(lo, hi, array, *args), len(levels.levels), len(levels.levels))
        g_points = torch.einsum("nf,naf->na", g_out, jacobian) if ctx.needs_input_grad[0] else None
        return g_points, g_table, None


def interpolate(points: Tensor, table: Tensor, levels: Levels) -> tuple[Tensor, Tensor]:
    """Features (n, L D) of points (n, 3) blended from `table` (rows, D), level by level, and their Jacobian (n, 3, L D) by x, y, z.

    Points outside the box take the features of the nearest point in it. On a GPU the twin is used.
    """
    if points.is_cuda:
        return interpolate_reference(points, table, levels)
    out, jacobian = _Interpolate.apply(points, table, levels)
    return out, jacobian
