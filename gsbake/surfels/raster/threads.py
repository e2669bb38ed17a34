"""Runs kernel calls that release the GIL on a small thread pool of our own.

Work is cut into more chunks than threads, so that heavy tiles balance; results do not depend on the number of threads because every
chunk writes only its own outputs.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

_configured = 0


def configure(threads: int) -> None:
    """Give the kernels `threads` threads and torch one.

    What torch is left with in a training step are many small operations: a team of OpenMP threads gains nothing on them, and whenever
    another
    process holds a core every barrier waits for it (seen: 10x slower steps beside one busy process).
    """
    global _configured
    import torch

    _configured = max(1, threads)
    torch.set_num_threads(1)


def thread_count() -> int:
    """Threads the kernels use: as configured, else torch's setting."""
    import torch

    return _configured or max(1, torch.get_num_threads())


@lru_cache(maxsize=4)
def _pool(pid: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gsbake-kernel")


def run_chunks(call: Callable[[int, int], object], count: int, chunks_per_thread: int = 6, minimum: int = 1) -> None:
    """Call `call(start, stop)` over 0..count in chunks of at least `minimum`, on all threads; errors are re-raised."""
    threads = thread_count()
    if count <= 0:
        return
    size = max(minimum, -(-count // (threads * chunks_per_thread)))
    if threads == 1 or count <= size:
        call(0, count)
        return
    pool = _pool(os.getpid(), threads)
    futures = [pool.submit(call, lo, min(lo + size, count)) for lo in range(0, count, size)]
    for future in futures:
        future.result()
