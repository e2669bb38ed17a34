"""Hole filling: solves for the unknown samples of a distance field on a sparse lattice.

`solve_laplace` solves Laplace's equation: the steady state of Davis et al., *Filling holes in complex surfaces using volumetric
diffusion*, 3DPVT 2002. `minimise_area` continues towards the field of minimal total variation, whose zero set is the minimal surface
between the known parts (flat below an object that stood on a table), by lagged diffusivity (Vogel & Oman, *Iterative methods for total
variation denoising*, 1996): div(∇f / |∇f|) = 0 with |∇f| from the previous round.

Red-black successive over-relaxation: samples of one colour only read the other colour, so threads do not change the result.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from gsbake.geometry.sparse_lattice import EDGE, BlockLattice, Floats
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

#: Minimum slope (per sample) in conductivities; it keeps the transition a few samples wide.
MIN_SLOPE = 0.01


def solve_laplace(lattice: BlockLattice, values: Floats, unknown: NDArray[np.bool_], sweeps: int, rate: float) -> None:
    """Relax the `unknown` samples of `values` (n, 8, 8, 8) in place; the others are fixed. `rate` in (0, 2); 1 is Gauss-Seidel."""
    _sweeps(lattice, _blocks_with(unknown), values, unknown, np.ones((1, 1, 1, 1), np.float32), sweeps, rate)


def minimise_area(
    lattice: BlockLattice, values: Floats, unknown: NDArray[np.bool_], blocks: NDArray[np.int64], sweeps: int, rate: float, rounds: int
) -> None:
    """Minimise the area of the zero set of `values` in the `unknown` samples of `blocks` by `rounds` of reweighted diffusion.

    Initialise with `solve_laplace`; unknown samples of other blocks are fixed.
    """
    rows = _blocks_with(unknown)
    conductivity = np.ones(values.shape, np.float32)
    for _ in range(rounds if len(blocks) else 0):
        run_chunks(partial(_run_kernel, _conductivity, (lattice.index, lattice.coords, rows, values, conductivity)), len(rows))
        _sweeps(lattice, blocks, values, unknown, conductivity, sweeps, rate)


def sign_change_blocks(lattice: BlockLattice, values: Floats, unknown: NDArray[np.bool_], widen: int = 1) -> NDArray[np.int64]:
    """Blocks of a dense lattice where `values` changes sign next to an `unknown` sample, dilated by `widen` blocks."""
    field, is_unknown = lattice.dense(values) < 0, lattice.dense(unknown.astype(np.float32)) > 0
    sign_change = np.zeros(field.shape, np.bool_)
    for axis in range(3):
        a = tuple(slice(None, -1) if d == axis else slice(None) for d in range(3))
        b = tuple(slice(1, None) if d == axis else slice(None) for d in range(3))
        sign_change[a] |= (field[a] != field[b]) & (is_unknown[a] | is_unknown[b])
    x, y, z = lattice.shape
    blocks_hit = sign_change.reshape(x, EDGE, y, EDGE, z, EDGE).any(axis=(1, 3, 5))
    if widen:
        blocks_hit = binary_dilation(blocks_hit, np.ones((3, 3, 3), np.bool_), iterations=widen)
    return np.sort(lattice.index[blocks_hit & (lattice.index >= 0)]).astype(np.int64)


def _blocks_with(selected: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of blocks with any selected sample."""
    return np.flatnonzero(selected.any(axis=(1, 2, 3)))


def _sweeps(
    lattice: BlockLattice, rows: Any, values: Floats, unknown: NDArray[np.bool_], conductivity: Floats, sweeps: int, rate: float
) -> None:
    for sweep in range(2 * sweeps):
        half = (lattice.index, lattice.coords, rows, values, unknown, conductivity, sweep % 2, np.float32(rate))
        run_chunks(partial(_run_kernel, _half_sweep, half), len(rows), chunks_per_thread=2)


def _run_kernel(kernel: Any, arguments: tuple[Any, ...], start: int, stop: int) -> None:
    kernel(start, stop, *arguments)


@nb.njit(cache=True, nogil=True, forceinline=True)
def _block_of_sample(index: Any, coords: Any, row: int, i: int, j: int, k: int) -> Any:
    """Row of the block of the sample at local (i, j, k) of block `row`, at most one step outside it; -1 when not allocated."""
    if 0 <= i < EDGE and 0 <= j < EDGE and 0 <= k < EDGE:
        return row
    a = coords[row, 0] + i // EDGE
    b = coords[row, 1] + j // EDGE
    c = coords[row, 2] + k // EDGE
    if a < 0 or b < 0 or c < 0 or a >= index.shape[0] or b >= index.shape[1] or c >= index.shape[2]:
        return -1
    return np.int64(index[a, b, c])


@kernel(
    "i8, i8, i4[:, :, ::1], i4[:, ::1], i8[::1], f4[:, :, :, ::1], b1[:, :, :, ::1], f4[:, :, :, ::1], i8, f4",
    nogil=True, error_model="numpy",
)
def _half_sweep(
    start: int, stop: int, index: Any, coords: Any, rows: Any, values: Any, unknown: Any, conductivity: Any, parity: int, rate: float
) -> None:
    """Relax one colour. Missing neighbours are skipped (zero slope). A `conductivity` of one element means 1 everywhere."""
    uniform = conductivity.shape[0] == 1
    for n in range(start, stop):
        row = rows[n]
        for i in range(EDGE):
            for j in range(EDGE):
                for k in range((i + j + parity) % 2, EDGE, 2):
                    if not unknown[row, i, j, k]:
                        continue
                    total = np.float32(0)
                    weight_sum = np.float32(0)
                    for side in range(6):
                        axis = side >> 1
                        step = ((side & 1) << 1) - 1
                        a = i + step * (axis == 0)
                        b = j + step * (axis == 1)
                        c = k + step * (axis == 2)
                        neighbour = _block_of_sample(index, coords, row, a, b, c)
                        if neighbour < 0:
                            continue
                        a, b, c = a & (EDGE - 1), b & (EDGE - 1), c & (EDGE - 1)
                        weight = np.float32(1)
                        if not uniform:
                            weight = conductivity[row, i, j, k] + conductivity[neighbour, a, b, c]
                        total += weight * values[neighbour, a, b, c]
                        weight_sum += weight
                    if weight_sum > 0:
                        values[row, i, j, k] += rate * (total / weight_sum - values[row, i, j, k])


@kernel("i8, i8, i4[:, :, ::1], i4[:, ::1], i8[::1], f4[:, :, :, ::1], f4[:, :, :, ::1]", nogil=True, error_model="numpy")
def _conductivity(start: int, stop: int, index: Any, coords: Any, rows: Any, values: Any, out: Any) -> None:
    """1 / |∇f| by central differences, one-sided at the boundary."""
    for n in range(start, stop):
        row = rows[n]
        for i in range(EDGE):
            for j in range(EDGE):
                for k in range(EDGE):
                    squares = np.float32(MIN_SLOPE * MIN_SLOPE)
                    for axis in range(3):
                        slope = np.float32(0)
                        samples = 0
                        for step in (-1, 1):
                            a = i + step * (axis == 0)
                            b = j + step * (axis == 1)
                            c = k + step * (axis == 2)
                            neighbour = _block_of_sample(index, coords, row, a, b, c)
                            if neighbour >= 0:
                                slope += step * values[neighbour, a % EDGE, b % EDGE, c % EDGE]
                                samples += 1
                            else:
                                slope += step * values[row, i, j, k]
                        if samples > 0:
                            slope /= samples
                            squares += slope * slope
                    out[row, i, j, k] = np.float32(1) / np.sqrt(squares)
