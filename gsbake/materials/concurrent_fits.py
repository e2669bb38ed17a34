"""Fits that do not depend on each other, at the same time, each on its share of the threads.

A step of a fit is many short kernels, which gain little from a second thread: they are too short, and arrays are allocated and indexed
between them. Two fits on a thread each take two thirds of the time of one after the other on both. Their results are the same: kernels sum
in a fixed order, and no fit writes what another one reads.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

import numba

Result = TypeVar("Result")
#: Called after every step with the number of steps done and their total; may raise to stop.
Each = Callable[[int, int], None]

#: Threading layers of Numba that several threads may call at a time; its own `workqueue` aborts.
_THREAD_SAFE = ("omp", "tbb")


def run_concurrently(fits: Sequence[Callable[[Each], Result]], each: Each) -> list[Result]:
    """The results of all `fits` in order; `each` is called by one at a time, with the steps of all together.

    A fit that raises, `each` included, lets the others come to their next step, and then raises here.
    """
    threads = numba.get_num_threads()
    workers = min(threads, len(fits)) if _thread_safe() else 1
    progress = _Progress(len(fits), each)
    if workers < 2:
        return [fit(progress.of(index)) for index, fit in enumerate(fits)]

    def run(index: int) -> Result:
        try:
            return fits[index](progress.of(index))
        except BaseException:
            progress.stopped = True
            raise

    with ThreadPoolExecutor(workers, "gsbake-fit", numba.set_num_threads, (threads // workers,)) as pool:
        try:
            running = [pool.submit(run, index) for index in range(len(fits))]
            wait(running)
        finally:
            progress.stopped = True  # where waiting was interrupted
    for error in filter(None, (future.exception() for future in running)):
        if not isinstance(error, _Stopped):
            raise error
    return [future.result() for future in running]


class _Stopped(Exception):
    """Another fit has raised."""


class _Progress:
    """Steps of `count` fits together, reported to `each`."""

    def __init__(self, count: int, each: Each) -> None:
        self._done, self._total, self._each = [0] * count, [0] * count, each
        self._lock, self.stopped = threading.Lock(), False

    def of(self, index: int) -> Each:
        """What the fit `index` calls after every step."""

        def step(done: int, total: int) -> None:
            with self._lock:
                if self.stopped:
                    raise _Stopped
                self._done[index], self._total[index] = done, total
                self._each(sum(self._done), sum(total or max(self._total) for total in self._total))

        return step


def _thread_safe() -> bool:
    """Whether several threads may run kernels at a time."""
    try:
        return numba.threading_layer() in _THREAD_SAFE
    except ValueError:  # no parallel kernel has run yet
        return False
