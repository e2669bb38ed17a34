"""Garbage collection of an output folder: artifacts of old keys, and what killed runs left behind.

Artifacts are deleted least recently used first; the newest one of each stage goes last. The user's replacements and files that were set
aside are never deleted. An artifact whose lease another process holds is skipped.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gsbake.pipeline.files import remove_tree
from gsbake.pipeline.key import KEY_PREFIX_LENGTH
from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.pipeline.store import ARTIFACT_FOLDER, CACHE, REPLACEMENT_PREFIX, Store


@dataclass(frozen=True)
class Entry:
    """A folder or file that may be deleted: its kind ("artifact", "checkpoint", "cache", "temporary folder", "lease"), size in bytes and
    the time of its last use in seconds since the epoch."""

    path: Path
    stage: str
    kind: str
    size: int
    used: float
    newest: bool = False


def list_entries(store: Store, stages: Iterable[str]) -> list[Entry]:
    """Everything in the stages' folders that may be deleted."""
    entries = []
    for stage in stages:
        found = []
        with suppress(FileNotFoundError, NotADirectoryError):
            found = [e for path in sorted(store.stage_folder(stage).iterdir()) if (e := _entry(path, stage)) is not None]
        artifacts = [e for e in found if e.kind == "artifact"]
        newest = max(artifacts, key=lambda e: e.used, default=None)
        entries += [Entry(e.path, e.stage, e.kind, e.size, e.used, e is newest) for e in found]
    return entries


def choose(entries: Iterable[Entry], keep: int | None = None, older: float | None = None, now: float | None = None) -> list[Entry]:
    """The entries to delete.

    Temporary folders and leases without a live holder: always. Artifacts, checkpoints and caches: those unused for `older` seconds, except
    the newest artifact of each stage; then, least recently used first, until at most `keep` bytes are left.
    """
    entries, now = list(entries), time.time() if now is None else now
    chosen = [e for e in entries if e.kind in ("temporary folder", "lease")]
    rest = sorted((e for e in entries if e.kind in ("artifact", "checkpoint", "cache")), key=lambda e: (e.newest, e.used))
    if older is not None:
        chosen += [e for e in rest if not e.newest and now - e.used > older]
    if keep is not None:
        left = [e for e in rest if e not in chosen]
        total = sum(e.size for e in left)
        while left and total > keep:
            chosen.append(left.pop(0))
            total -= chosen[-1].size
    return chosen


def delete(entries: Iterable[Entry]) -> list[Entry]:
    """Delete the entries that no process works on; returns those that were deleted."""
    done = []
    for entry in entries:
        lease = _lease_path(entry.path)
        holder = LeaseHolder.read(lease)
        if holder is not None and holder.alive() is not False:
            continue
        held = Lease(lease)
        held.acquire()
        try:
            if entry.path.is_dir():  # a lease file goes with the lease's release
                remove_tree(entry.path)
        finally:
            held.release()
        if not entry.path.exists():
            done.append(entry)
    return done


def _lease_path(path: Path) -> Path:
    prefix = REPLACEMENT_PREFIX if path.name.startswith(REPLACEMENT_PREFIX) else path.name[:KEY_PREFIX_LENGTH]
    return path.with_name(f"{prefix}.lease")


def _entry(path: Path, stage: str) -> Entry | None:
    name = path.name
    if name.endswith(".lease"):
        return Entry(path, stage, "lease", path.stat().st_size, path.stat().st_mtime)
    if name.startswith(".") or not path.is_dir():
        return None
    if ".tmp-" in name:
        kind = "temporary folder"
    elif name.endswith(".checkpoint"):
        kind = "checkpoint"
    elif name == CACHE:
        kind = "cache"
    elif ARTIFACT_FOLDER.fullmatch(name):
        kind = "artifact"
    else:
        return None
    return Entry(path, stage, kind, _tree_size(path), path.stat().st_mtime)


def _tree_size(folder: Path) -> int:
    total = 0
    for root, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(root, name)).st_size
    return total
