"""Content digests (BLAKE3) of files and folders, and a cache of them that cannot be fooled by a quick edit.

A digest depends on relative names and bytes only, never on where a folder lies or when it was written, so a copy of a capture on
another machine has the same keys. The cache remembers a file's digest by (device, inode, size, mtime, ctime). As in Git's index, an entry
is stored only when the file was at rest for a while before it was read: a file that is rewritten within one tick of the clock
would look unchanged.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from blake3 import blake3

from gsbake.pipeline.files import write_atomic

#: Seconds a file must have been at rest before its digest is remembered (FAT keeps times to 2 s, the coarsest in use).
SETTLED = 2.5

_SMALL = 1 << 20  # below this a plain read is quicker than a memory map


def file_digest(path: Path) -> str:
    """BLAKE3 of the file's bytes, in hexadecimal."""
    if path.stat().st_size < _SMALL:
        return blake3(path.read_bytes()).hexdigest()
    return blake3(max_threads=blake3.AUTO).update_mmap(path).hexdigest()


def tree_digest(files: Mapping[str, str]) -> str:
    """One digest for a set of files, from {relative name: digest of its content}."""
    body = json.dumps(sorted(files.items()), ensure_ascii=True, separators=(",", ":"))
    return blake3(body.encode()).hexdigest()


def list_files(folder: Path, *, deep: bool = True) -> list[str]:
    """Relative POSIX names of all files in the folder (not hidden ones), sorted; `deep` follows sub-folders."""
    found: list[str] = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith("."):
                continue
            if entry.is_file():
                found.append(entry.name)
            elif deep and entry.is_dir():
                found += [f"{entry.name}/{name}" for name in list_files(Path(entry.path))]
    return sorted(found)


class DigestCache:
    """File digests remembered between runs in one JSON file; without a file it remembers nothing."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._entries: dict[str, list[object]] = {}
        self._changed = False
        if path is not None:
            with suppress(OSError, ValueError):
                body = json.loads(path.read_text())
                if isinstance(body, dict):
                    self._entries = body

    def file(self, path: Path) -> str:
        """Digest of one file, from memory when the file is certainly the one seen before."""
        path = Path(os.path.abspath(path))
        before = path.stat()
        stamp = [before.st_dev, before.st_ino, before.st_size, before.st_mtime_ns, before.st_ctime_ns]
        entry = self._entries.get(str(path))
        if isinstance(entry, list) and entry[:-1] == stamp:
            return str(entry[-1])
        now = time.time()
        digest = file_digest(path)
        after = path.stat()
        still = [after.st_dev, after.st_ino, after.st_size, after.st_mtime_ns, after.st_ctime_ns] == stamp
        if still and max(before.st_mtime, before.st_ctime) < now - SETTLED:
            self._entries[str(path)] = [*stamp, digest]
            self._changed = True
        return digest

    def files(self, root: Path, names: Iterable[str]) -> dict[str, str]:
        """{name: digest} of the files `names` under `root`."""
        return {name: self.file(root / name) for name in names}

    def source(self, path: Path, names: Iterable[str] | None = None) -> dict[str, str]:
        """{name: digest} of what the person gave: a file, or the files `names` in a folder (those directly in it without names)."""
        if path.is_dir():
            return self.files(path, list_files(path, deep=False) if names is None else names)
        return {path.name: self.file(path)}

    def save(self) -> None:
        """Write the cache; a folder that cannot be written only costs the next run time."""
        if self._changed and self.path is not None:
            with suppress(OSError):
                write_atomic(self.path, json.dumps(self._entries))
            self._changed = False
