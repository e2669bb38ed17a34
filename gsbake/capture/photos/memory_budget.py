"""Share of the memory that photos decoded at the same time may take, so that large photos wait for each other instead of filling it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import psutil

#: Bytes that decoding, conversion to linear and filtering hold per decoded byte: 8-bit samples become 32-bit floats and a copy.
BYTES_PER_DECODED_BYTE = 10
#: Share of the available memory that photos may take.
SHARE = 0.5


class MemoryBudget:
    """A number of bytes that threads share; by default SHARE of what is available when it is made."""

    def __init__(self, total: int | None = None) -> None:
        self.total = int(SHARE * psutil.virtual_memory().available) if total is None else total
        self._free = self.total
        self._changed = threading.Condition()

    @contextmanager
    def reserve(self, size: int) -> Iterator[None]:
        """Hold `size` bytes; waits until they are free. More than the total waits until nothing else is held."""
        size = min(size, self.total)
        with self._changed:
            self._changed.wait_for(lambda: self._free >= size)
            self._free -= size
        try:
            yield
        finally:
            with self._changed:
                self._free += size
                self._changed.notify_all()
