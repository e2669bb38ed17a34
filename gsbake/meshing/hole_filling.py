"""Filling the unknown part of a distance field between its known parts, on the samples of a sparse lattice.

`diffuse` solves Laplace's equation: Davis et al., *Filling holes in complex surfaces using volumetric diffusion*, 3DPVT 2002, at its
steady state. `span` goes on from there towards the field of least total variation, whose zero set is the surface of least area between
the known parts (a soap film: flat under an object that stood on a table), by lagged diffusivity (Vogel & Oman, *Iterative
methods for total variation denoising*, 1996): div(∇f / |∇f|) = 0 with the last |∇f|.

Red-black over-relaxation: samples of one colour only read the other colour, so threads do not change the result.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from gsbake.meshing.sparse_lattice import EDGE, BlockLattice, Floats
from gsbake.surfels.raster.threads import run_chunks

#: Slopes (per sample) below this count as flat when conductivities are computed; it keeps the film a few samples thick.
FLAT = 0.01


def diffuse(lattice: BlockLattice, values: Floats, unknown: NDArray[np.bool_], sweeps: int, rate: float) -> None:
    """Relax the `unknown` samples of `values` (n, 8, 8, 8) in place; the others stay. `rate` in (0, 2); 1 is Gauss-Seidel."""
    _sweeps(lattice, _rows(unknown), values, unknown, np.ones((1, 1, 1, 1), np.float32), sweeps, rate)


def span(
    lattice: BlockLattice, values: Floats, unknown: NDArray[np.bool_], blocks: NDArray[np.int64], sweeps: int, rate: float, rounds: int
) -> None:
    """Draw the zero set of `values` tight where it runs through `unknown` samples of `blocks`: `rounds` of reweighted diffusion.

    Start from `diffuse`; unknown samples of other blocks stay at what they are.
    """
    around = _rows(unknown)
    conductivity = np.ones(values.shape, np.float32)
    for _ in range(rounds if len(blocks) else 0):
        run_chunks(partial(_call, _conductivity, (lattice.index, lattice.coords, around, values, conductivity)), len(around))
        _sweeps(lattice, blocks, values, unknown, conductivity, sweeps, rate)


def crossing_blocks(lattice: BlockLattice, values: Floats, unknown: NDArray[np.bool_], widen: int = 1) -> NDArray[np.int64]:
    """Blocks of a dense lattice where `values` changes sign next to an `unknown` sample, and those `widen` blocks around."""
    field, open_ = lattice.dense(values) < 0, lattice.dense(unknown.astype(np.float32)) > 0
    crossing = np.zeros(field.shape, np.bool_)
    for axis in range(3):
        a = tuple(slice(None, -1) if d == axis else slice(None) for d in range(3))
        b = tuple(slice(1, None) if d == axis else slice(None) for d in range(3))
        crossing[a] |= (field[a] != field[b]) & (open_[a] | open_[b])
    x, y, z = lattice.shape
    hit = crossing.reshape(x, EDGE, y, EDGE, z, EDGE).any(axis=(1, 3, 5))
    if widen:
        hit = binary_dilation(hit, np.ones((3, 3, 3), np.bool_), iterations=widen)
    return np.sort(lattice.index[hit & (lattice.index >= 0)]).astype(np.int64)


def _rows(chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Blocks with any chosen sample."""
    return np.flatnonzero(chosen.any(axis=(1, 2, 3)))


def _sweeps(
    lattice: BlockLattice, rows: Any, values: Floats, unknown: NDArray[np.bool_], conductivity: Floats, sweeps: int, rate: float
) -> None:
    for sweep in range(2 * sweeps):
        half = (lattice.index, lattice.coords, rows, values, unknown, conductivity, sweep % 2, np.float32(rate))
        run_chunks(partial(_call, _half_sweep, half), len(rows), chunks_per_thread=2)


def _call(kernel: Any, arguments: tuple[Any, ...], start: int, stop: int) -> None:
    kernel(start, stop, *arguments)


@nb.njit(cache=True, nogil=True, inline="always")
def _place(index: Any, coords: Any, row: int, i: int, j: int, k: int) -> Any:
    """The block that holds the sample at block-local (i, j, k), at most one step outside block `row`; -1 when there is none."""
    if 0 <= i < EDGE and 0 <= j < EDGE and 0 <= k < EDGE:
        return row
    a = coords[row, 0] + i // EDGE
    b = coords[row, 1] + j // EDGE
    c = coords[row, 2] + k // EDGE
    if a < 0 or b < 0 or c < 0 or a >= index.shape[0] or b >= index.shape[1] or c >= index.shape[2]:
        return -1
    return np.int64(index[a, b, c])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _half_sweep(
    start: int, stop: int, index: Any, coords: Any, rows: Any, values: Any, unknown: Any, conductivity: Any, parity: int, rate: float
) -> None:
    """One colour. Neighbours that do not exist are left out, which is a zero slope there. A single conductivity stands for ones."""
    even = conductivity.shape[0] == 1
    for n in range(start, stop):
        row = rows[n]
        for i in range(EDGE):
            for j in range(EDGE):
                for k in range((i + j + parity) % 2, EDGE, 2):
                    if not unknown[row, i, j, k]:
                        continue
                    total = np.float32(0)
                    mass = np.float32(0)
                    for side in range(6):
                        axis = side >> 1
                        step = ((side & 1) << 1) - 1
                        a = i + step * (axis == 0)
                        b = j + step * (axis == 1)
                        c = k + step * (axis == 2)
                        other = _place(index, coords, row, a, b, c)
                        if other < 0:
                            continue
                        a, b, c = a & (EDGE - 1), b & (EDGE - 1), c & (EDGE - 1)
                        weight = np.float32(1)
                        if not even:
                            weight = conductivity[row, i, j, k] + conductivity[other, a, b, c]
                        total += weight * values[other, a, b, c]
                        mass += weight
                    if mass > 0:
                        values[row, i, j, k] += rate * (total / mass - values[row, i, j, k])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _conductivity(start: int, stop: int, index: Any, coords: Any, rows: Any, values: Any, out: Any) -> None:
    """1 / |∇f| with central differences, one-sided at the border."""
    for n in range(start, stop):
        row = rows[n]
        for i in range(EDGE):
            for j in range(EDGE):
                for k in range(EDGE):
                    squares = np.float32(FLAT * FLAT)
                    for axis in range(3):
                        slope = np.float32(0)
                        reach = 0
                        for step in (-1, 1):
                            a = i + step * (axis == 0)
                            b = j + step * (axis == 1)
                            c = k + step * (axis == 2)
                            other = _place(index, coords, row, a, b, c)
                            if other >= 0:
                                slope += step * values[other, a % EDGE, b % EDGE, c % EDGE]
                                reach += 1
                            else:
                                slope += step * values[row, i, j, k]
                        if reach > 0:
                            slope /= reach
                            squares += slope * slope
                    out[row, i, j, k] = np.float32(1) / np.sqrt(squares)
