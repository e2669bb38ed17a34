"""The one budget of memory for reading what comes from outside: photos, masks, meshes, glTF files, images in them, priors, pose files.

A file of a few kilobytes can ask for a terabyte: compressed images, counts without data, one mesh placed a million times. A reader
therefore states from the headers what decoding would take, before it decodes, and a file that needs more than there is is refused by name.
The budget is a share of the memory that is free when it is asked for, within the limits of machine, container and process.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsbake.errors import BadInputError
from gsbake.system.limits import available_memory

#: Share of the available memory that reading may take; the rest is for what is done with it.
SHARE = 0.75
#: Least and most bytes: below, no photo of a telephone could be read, and whether it fits is for the system to say; no file needs more.
MINIMUM, MAXIMUM = 256 << 20, 64 << 30
#: Most bytes of Python's objects per character of JSON that begins an object or a list, or ends a key or a value.
_JSON_BYTES = {b"{": 240, b"[": 128, b":": 110, b",": 72}


def budget() -> int:
    """Bytes that reading may take now."""
    return int(min(max(SHARE * available_memory(), MINIMUM), MAXIMUM))


def check(needed: int, name: str) -> None:
    """Raise BadInputError when reading `name` takes `needed` bytes and the budget is smaller."""
    available = budget()
    if needed > available:
        raise too_large(needed, available, name)


def too_large(needed: int, available: int, name: str) -> BadInputError:
    """The error of a file that needs more bytes than are available."""
    remedy = "reduce it, or read it on a machine with more memory"
    return BadInputError(f"{name} needs {_gigabytes(needed)} of memory to be read, and {_gigabytes(available)} may be used; {remedy}.")


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.3g} GB" if size < 10**15 else "more than a petabyte"


def child_limit(needed: int, spare: int) -> int:
    """Bytes of address space for a child that reads what takes `needed` bytes: with `spare` for libraries, never more than there is."""
    return min(needed + spare, max(available_memory(), spare))


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises BadInputError for one that is larger than the memory, as a sparse one can be, and OSError."""
    check(path.stat().st_size, f"'{path}'")
    return path.read_bytes()


def json_bytes(data: bytes) -> int:
    """Bytes that the objects of a JSON document can take, from its punctuation."""
    return len(data) + sum(data.count(character) * size for character, size in _JSON_BYTES.items())


class MemoryBudget:
    """The budget shared by threads, so that large photos wait for each other instead of filling the memory together."""

    def __init__(self, total: int | None = None) -> None:
        self.total = budget() if total is None else total
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
