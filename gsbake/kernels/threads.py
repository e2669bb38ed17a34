"""Thread pool for kernels that release the GIL.

Work is split into more chunks than threads to balance the load. Each chunk writes only its own outputs, so results do not depend on the
number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

import numba

T = TypeVar("T")

_configured = 0


def configure(threads: int) -> None:
    """Give the kernels `threads` threads and torch one.

    Torch's share of a training step is many small operations, which gain nothing from OpenMP threads. When another process holds a core,
    every OpenMP barrier waits for it (measured: 10x slower steps beside one busy process).
    """
    global _configured
    import torch

    _configured = max(1, threads)
    torch.set_num_threads(1)


def thread_count() -> int:
    """Threads of the kernels: the configured number, else Numba's (NUMBA_NUM_THREADS, which the engine sets, or all cores)."""
    return _configured or int(numba.get_num_threads())


@lru_cache(maxsize=4)
def _pool(pid: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gsbake-kernel")


def run_chunks(call: Callable[[int, int], T], count: int, chunks_per_thread: int = 6, minimum: int = 1) -> list[T]:
    """Run `call(start, stop)` over 0..count in chunks of at least `minimum` items on all threads; the results in order.

    Exceptions are re-raised.
    """
    threads = thread_count()
    if count <= 0:
        return []
    size = max(minimum, -(-count // (threads * chunks_per_thread)))
    if threads == 1 or count <= size:
        return [call(0, count)]
    pool = _pool(os.getpid(), threads)
    futures = [pool.submit(call, lo, min(lo + size, count)) for lo in range(0, count, size)]
    return [future.result() for future in futures]
