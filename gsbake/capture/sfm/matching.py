"""Exact matching of SIFT descriptors: nearest neighbours, ratio test and cross check (Lowe, IJCV 2004).

COLMAP's approximate matcher gives other matches now and then when several threads share it, and its exact one is much slower. Here
the products of all descriptors come from one matrix product per block of rows, whose sums are exact in single precision (descriptors are
whole numbers of at most 8 bits and about 512 long), so matches depend on neither threads nor machine.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.declaration import kernel

Floats = NDArray[np.float32]
Matches = NDArray[np.uint32]

#: Largest ratio of the distances to the best and the second-best match, and largest distance, of descriptors of unit length.
MAX_RATIO, MAX_DISTANCE = 0.8, 0.7
#: Length of SIFT descriptors as COLMAP stores them.
_LENGTH = 512.0
#: Descriptors of the first photo per matrix product; the products of a block stay in the cache.
_BLOCK = 256
#: Independent maxima of a row, so that the loop over its columns is vectorised.
_LANES = 64


@kernel("f4[:, ::1], i8, i4[::1], f4[::1], f4[::1], i4[::1], f4[::1], f4[::1]", nogil=True)
def _two_best(
    products: Floats, start: int, row: NDArray[np.int32], row_first: Floats, row_second: Floats,
    column: NDArray[np.int32], column_first: Floats, column_second: Floats,
) -> None:  # fmt: skip
    """Update the best index and the two largest values of rows and columns by `products` (m, n), the rows from `start` on."""
    m, n = products.shape
    first, second = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    whole = n // _LANES * _LANES
    for i in range(m):
        values = products[i]
        for k in range(_LANES):
            first[k] = second[k] = -1.0
        for j in range(0, whole, _LANES):
            for k in range(_LANES):
                value = values[j + k]
                second[k] = max(second[k], min(first[k], value))
                first[k] = max(first[k], value)
        for j in range(whole, n):
            second[0] = max(second[0], min(first[0], values[j]))
            first[0] = max(first[0], values[j])
        best, next_best = np.float32(-1.0), np.float32(-1.0)
        for k in range(_LANES):
            next_best = max(next_best, min(best, first[k]), second[k])
            best = max(best, first[k])
        row_first[start + i], row_second[start + i] = best, next_best
        for j in range(n):
            if values[j] == best:
                row[start + i] = j
                break
    for i in range(m):
        values, index = products[i], np.int32(start + i)
        for j in range(n):
            value, best = values[j], column_first[j]
            column_second[j] = max(column_second[j], min(best, value))
            column_first[j] = max(best, value)
            column[j] = index if value > best else column[j]


def match_descriptors(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Matches:
    """Matches (m, 2), indices into the SIFT descriptors `a` (n, 128) and `b` (k, 128), ascending in the first.

    Each is the other's best match, nearer than MAX_DISTANCE, and MAX_RATIO times nearer than the second best on both sides. Of equally
    good ones the first counts, and the ratio test refuses it.
    """
    if not len(a) or not len(b):
        return np.zeros((0, 2), np.uint32)
    left, right = a.astype(np.float32), np.ascontiguousarray(b.astype(np.float32).T)
    row, column = np.zeros(len(a), np.int32), np.zeros(len(b), np.int32)
    row_first, row_second = np.full((2, len(a)), -1, np.float32)
    column_first, column_second = np.full((2, len(b)), -1, np.float32)
    products = np.empty((_BLOCK, len(b)), np.float32)
    for start in range(0, len(a), _BLOCK):
        block = left[start : start + _BLOCK]
        values = np.matmul(block, right, out=products[: len(block)])
        _two_best(values, start, row, row_first, row_second, column, column_first, column_second)
    good = _is_distinctive(row_first, row_second) & _is_distinctive(column_first, column_second)[row]
    good &= column[row] == np.arange(len(a))
    index = np.flatnonzero(good)
    return np.stack([index, row[index]], 1).astype(np.uint32)


def _is_distinctive(first: Floats, second: Floats) -> NDArray[np.bool_]:
    """Whether best matches pass both tests, from the largest and second-largest products of descriptors (-1 where there is no second)."""
    nearest, next_nearest = (np.maximum(2 - 2 * product / np.float32(_LENGTH**2), 0) for product in (first, second))
    return np.asarray((nearest <= MAX_DISTANCE**2) & (nearest < MAX_RATIO**2 * next_nearest))


def match_pairs(
    pairs: Iterable[tuple[int, int]], descriptors: Callable[[int], NDArray[np.uint8]], threads: int
) -> Iterator[tuple[tuple[int, int], Matches]]:
    """Pairs of photos and their matches, in order; `descriptors` of a photo is called by the calling thread only."""
    pending: deque[tuple[tuple[int, int], Future[Matches]]] = deque()
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for pair in pairs:
            pending.append((pair, pool.submit(match_descriptors, descriptors(pair[0]), descriptors(pair[1]))))
            if len(pending) > 2 * threads:
                done, future = pending.popleft()
                yield done, future.result()
        for done, future in pending:
            yield done, future.result()
