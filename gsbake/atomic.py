"""Atomic, flushed writing of files: a file has its old content or its new one, also after a crash."""

from __future__ import annotations

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

#: errno values of a file system that does not flush folders; any other failure means that data may be lost.
CANNOT_SYNC = frozenset({errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF})


def sync(path: Path) -> None:
    """Flush a file or folder to disk. Raises OSError when that fails; file systems that cannot flush folders are accepted."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in CANNOT_SYNC or not path.is_dir():
            raise
    finally:
        os.close(handle)


@contextmanager
def atomic_replacement(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A temporary path beside `path` that replaces it when the block succeeds (flushed first if `durable`); deleted when it fails."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield temporary
        if durable:
            sync(temporary)
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def write_atomic(path: Path, content: str | bytes, *, durable: bool = False) -> None:
    """Replace the content of `path` atomically; text is written as UTF-8."""
    with atomic_replacement(path, durable=durable) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
