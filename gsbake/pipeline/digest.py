"""Content digests (BLAKE3) of files and folders, and a cache of file digests.

A digest depends on relative names and bytes only, not on paths or times, so a copy of a capture on another machine has the same cache
keys. The cache stores a file's digest under (device, inode, size, mtime, ctime). As in Git's index, an entry is stored only when the file
has been unmodified for a minimum time: a file rewritten within the timestamp resolution would look unchanged.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from blake3 import blake3

from gsbake.atomic import write_atomic
from gsbake.system.names import is_digest

#: Minimum time since the last modification, in seconds, for a digest to be cached. FAT has the coarsest timestamps, 2 s.
MIN_FILE_AGE = 2.5

_STAMP_LENGTH = 5
_MMAP_MIN_SIZE = 1 << 20  # bytes; smaller files are read faster than mapped


def file_digest(path: Path) -> str:
    """BLAKE3 of the file's bytes, in hexadecimal."""
    if path.stat().st_size < _MMAP_MIN_SIZE:
        return blake3(path.read_bytes()).hexdigest()
    return blake3(max_threads=blake3.AUTO).update_mmap(path).hexdigest()


def tree_digest(files: Mapping[str, str]) -> str:
    """One digest of a set of files, from {relative name: content digest}."""
    body = json.dumps(sorted(files.items()), ensure_ascii=True, separators=(",", ":"))
    return blake3(body.encode()).hexdigest()


def list_files(folder: Path, *, recursive: bool = True) -> list[str]:
    """Sorted relative POSIX names of the files in a folder without hidden ones; `recursive` includes subfolders.

    Links to files count as files; links to folders are not followed, as they may lead anywhere.
    """
    found: list[str] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_file():
                found.append(entry.name)
            elif recursive and entry.is_dir(follow_symlinks=False):
                found += [f"{entry.name}/{name}" for name in list_files(Path(entry.path))]
    return sorted(found)


def file_stamps(paths: Iterable[Path]) -> dict[Path, tuple[int, ...] | None]:
    """{path: device, inode, size, mtime and ctime}; None for a missing file. A file that is written to changes its stamp."""
    stamps: dict[Path, tuple[int, ...] | None] = {}
    for path in paths:
        stamps[path] = None
        with suppress(OSError):
            stamps[path] = _stamp(path.stat())
    return stamps


def _stamp(status: os.stat_result) -> tuple[int, ...]:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def is_digest_cache(path: Path) -> bool:
    """Whether a file is a stored digest cache: {path: [stamp…, digest]}."""
    with suppress(OSError, ValueError, RecursionError):
        body = json.loads(path.read_bytes())
        rows = body.values() if isinstance(body, dict) else [None]
        return all(isinstance(row, list) and len(row) == _STAMP_LENGTH + 1 and is_digest(row[-1]) for row in rows)
    return False


class DigestCache:
    """File digests stored between runs in one JSON file; in memory only without a path."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._entries: dict[str, list[object]] = {}
        self._changed = False
        if path is not None:
            with suppress(OSError, ValueError, RecursionError):
                body = json.loads(path.read_text(encoding="utf-8"))
                if isinstance(body, dict):
                    self._entries = body

    def file(self, path: Path) -> str:
        """Content digest of one file; cached while its size, times and inode are unchanged."""
        path = Path(os.path.abspath(path))
        before = path.stat()
        stamp = list(_stamp(before))
        entry = self._entries.get(str(path))
        if isinstance(entry, list) and entry[:-1] == stamp:
            return str(entry[-1])
        now = time.time()
        digest = file_digest(path)
        unchanged = list(_stamp(path.stat())) == stamp
        if unchanged and max(before.st_mtime, before.st_ctime) < now - MIN_FILE_AGE:
            self._entries[str(path)] = [*stamp, digest]
            self._changed = True
        return digest

    def forget(self) -> None:
        """Drop all entries: every file is read again."""
        self._entries, self._changed = {}, True

    def files(self, root: Path, names: Iterable[str]) -> dict[str, str]:
        """{name: digest} of the files `names` under `root`."""
        return {name: self.file(root / name) for name in names}

    def source(self, path: Path, names: Iterable[str] | None = None) -> dict[str, str]:
        """{name: digest} of a user path: a file, or the files `names` of a folder (without names, the files directly in it)."""
        if path.is_dir():
            return self.files(path, list_files(path, recursive=False) if names is None else names)
        return {path.name: self.file(path)}

    def save(self) -> None:
        """Write the cache. Write errors are ignored: the next run computes the digests again."""
        if self._changed and self.path is not None:
            with suppress(OSError):
                write_atomic(self.path, json.dumps(self._entries))
            self._changed = False
