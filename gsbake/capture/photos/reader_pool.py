"""The processes that decode photos, and what becomes of those that a photo ends.

A photo whose decoder crashes or takes more memory than its size explains is unreadable, and its process is started again. One whose header
states more than the budget of memory is an error of the input, which is not stored: another machine may have more. A process that is killed
from outside or takes too long says nothing about the photo: the run is interrupted and nothing is stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

import numpy as np

from gsbake.capture.photos.conversion import Conversion, ConvertedPhoto
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.quality import Quality
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.limited_process import ParserFailedError, ParserKilledError, ParserProcess
from gsbake.memory_budget import MemoryBudget, too_large

#: Module of the child.
READER = "gsbake.capture.photos.reader_process"
#: Most processes that read photos.
MAX_READERS = 8
#: Seconds that a photo may take: at least, and per byte that it needs (a hundred megabytes a second). Far above any measured time.
MIN_SECONDS, SECONDS_PER_BYTE = 300.0, 1e-8
#: Threads of the libraries in a child; the pool runs in parallel instead.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENIMAGEIO_THREADS"), "1")


class ReaderProcesses:
    """`count` reader processes for as many threads of the caller, started when they are needed."""

    def __init__(self, count: int) -> None:
        self._all = [ParserProcess(READER, ONE_THREAD) for _ in range(count)]
        self._idle: SimpleQueue[ParserProcess] = SimpleQueue()
        for process in self._all:
            self._idle.put(process)

    @contextmanager
    def idle(self) -> Iterator[ParserProcess]:
        """One that no other thread uses; waits for it."""
        process = self._idle.get()
        try:
            yield process
        finally:
            self._idle.put(process)

    def close(self) -> None:
        """End them; a later request starts them again."""
        for process in self._all:
            process.close()


class ReaderPool:
    """Converts photos in `count` reader processes; a context manager that ends them."""

    def __init__(self, count: int, budget: MemoryBudget | None = None) -> None:
        self._budget = budget or MemoryBudget()
        self._processes = ReaderProcesses(count)

    def __enter__(self) -> ReaderPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._processes.close()

    def convert(self, what: Conversion) -> ConvertedPhoto:
        """Write the working files of a photo; waits for memory and for an idle process.

        Raises UnreadablePhotoError for the photo, BadInputError for its mask and for more memory than there is, OSError for the output,
        InterruptedRun.
        """
        size = int(self._ask("size", what, 0)["bytes"])
        if size > self._budget.total:
            raise too_large(size, self._budget.total, f"The photo {what.relative}" + (" with its mask" if what.mask else ""))
        with self._budget.reserve(size):
            found = self._ask("convert", what, size)
        quality = Quality(**{**found["quality"], "thumbnail": np.asarray(found["quality"]["thumbnail"], np.float32)})
        return ConvertedPhoto(found["entry"], int(found["orientation"]), quality)

    def _ask(self, task: str, what: Conversion, size: int) -> dict[str, Any]:
        with self._processes.idle() as process:
            return self._answer(process, task, what, size)

    def _answer(self, process: ParserProcess, task: str, what: Conversion, size: int) -> dict[str, Any]:
        request = {"task": task, "what": what.to_json(), "bytes": size}
        try:
            found = process.ask(request, MIN_SECONDS + SECONDS_PER_BYTE * size)
        except ParserKilledError as error:
            raise InterruptedRun(
                f"The process that read the photo {what.relative} {error}; run the same command, and remove the photo if it happens again."
            ) from error
        except ParserFailedError as error:
            if what.mask is None:
                raise UnreadablePhotoError(f"its decoder {error}") from error
            self._answer(process, task, replace(what, mask=None, use_mask=False), size)  # raises when the photo is at fault
            raise BadInputError(
                f"The mask {what.mask} of photo {what.relative} cannot be read (its decoder {error}); replace or remove it."
            ) from error
        if "unreadable" in found:
            raise UnreadablePhotoError(found["unreadable"])
        if "refused" in found:
            raise BadInputError(found["refused"])
        if "os_error" in found:
            raise OSError(*found["os_error"])
        return found


def submit_bounded(
    submit: Callable[[str], Future[ConvertedPhoto]], items: list[str], limit: int
) -> Iterator[tuple[str, Future[ConvertedPhoto]]]:
    """Submit items in order with at most `limit` pending, which bounds memory; yields them in order."""
    pending: list[tuple[str, Future[ConvertedPhoto]]] = []
    for item in items:
        pending.append((item, submit(item)))
        if len(pending) >= limit:
            yield pending.pop(0)
    yield from pending
