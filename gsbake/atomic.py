"""Atomic, flushed writing of files: a file has its old content or its new one, also after a crash."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsbake.system import disk


@contextmanager
def atomic_replacement(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A temporary path beside `path` that replaces it when the block succeeds (flushed first if `durable`); deleted when it fails."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield temporary
        if durable:
            disk.sync(temporary)
        disk.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def write_atomic(path: Path, content: str | bytes, *, durable: bool = False) -> None:
    """Replace the content of `path` atomically; text is written as UTF-8."""
    with atomic_replacement(path, durable=durable) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
