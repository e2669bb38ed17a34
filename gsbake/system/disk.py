"""Flushing, renaming, linking and reading of files that another process may be using."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

#: errno values of a file system that does not flush folders; any other failure means that data may be lost.
CANNOT_SYNC = frozenset({errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF})
#: Error codes of Windows for a file that another process, often a virus scanner, has open: access denied, sharing and lock violation.
_IN_USE = frozenset({5, 32, 33})
#: Seconds to wait for that process.
_PATIENCE = 2.0

_T = TypeVar("_T")


def sync(path: Path) -> None:
    """Flush a file or folder to disk. Raises OSError when that fails; systems and file systems that cannot flush folders are accepted.

    Windows flushes only what is open for writing, and keeps its folders by a journal of its own.
    """
    if os.name == "nt" and path.is_dir():
        return
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in CANNOT_SYNC or not path.is_dir():
            raise
    finally:
        os.close(handle)


def replace(source: Path, target: Path) -> None:
    """Rename a file or folder; a file that has the name already is replaced."""
    patiently(lambda: os.replace(source, target))


def read(path: Path) -> bytes:
    """The bytes of a file that another process may be replacing."""
    return patiently(path.read_bytes)


def link(source: Path, target: Path) -> None:
    """Give a file a second name, at once or not at all. Raises FileExistsError when another file has it; other OSErrors come from file
    systems without hard links."""
    os.link(source, target)


def patiently(operation: Callable[[], _T]) -> _T:
    """The result of `operation`, which is tried again while Windows says that another process has the file open."""
    deadline, pause = time.monotonic() + _PATIENCE, 0.01
    while True:
        try:
            return operation()
        except OSError as error:
            if getattr(error, "winerror", None) not in _IN_USE or time.monotonic() > deadline:
                raise
        time.sleep(pause)
        pause = min(2 * pause, 0.2)
