"""Garbage collection of an output folder: artifacts of old keys, and what killed runs left behind.

Artifacts are deleted least recently used first; the newest one of each stage goes last. Only names that gsbake gives are looked at, and
nothing behind a link. The user's replacements and files that were set aside are never deleted. An artifact is skipped while another process
holds its lease, or a run in progress uses it.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gsbake.errors import GsbakeError, UsageError
from gsbake.pipeline.files import remove_tree
from gsbake.pipeline.key import KEY_PREFIX_LENGTH
from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.pipeline.project import PROJECT, Project
from gsbake.pipeline.store import ARTIFACT_FOLDER, CACHE, REPLACEMENT_PREFIX, TEMPORARY_FOLDER, Store, lease_path
from gsbake.pipeline.uses import forget_killed, in_use

_KEY = rf"[0-9a-f]{{{KEY_PREFIX_LENGTH}}}"
#: Kinds of folders that may be deleted, by their names.
_KINDS = (
    ("artifact", ARTIFACT_FOLDER),
    ("temporary folder", TEMPORARY_FOLDER),
    ("checkpoint", re.compile(rf"{_KEY}\.checkpoint")),
    ("cache", re.compile(CACHE)),
)
_LEASE = re.compile(rf"({_KEY}|{REPLACEMENT_PREFIX})\.lease")


@dataclass(frozen=True)
class Entry:
    """A folder or file that may be deleted: its kind ("artifact", "checkpoint", "cache", "temporary folder", "lease"), size in bytes, the
    time of its last use in seconds since the epoch, and whether a run in progress uses it."""

    path: Path
    stage: str
    kind: str
    size: int
    used: float
    newest: bool = False
    in_use: bool = False

    @property
    def name(self) -> str:
        """Stage and name, as runs in progress give them."""
        return f"{self.stage}/{self.path.name}"


def require_run(out: Path) -> None:
    """Raise UsageError unless `out` is an output folder of gsbake: its `project.json` says so."""
    try:
        project = Project.load(out)
    except GsbakeError:
        project = None
    if project is None or project.photos is None:
        raise UsageError(f"'{out}' is no output folder of gsbake ({PROJECT} is missing, damaged or not its own); name one with --out.")


def list_entries(store: Store, stages: Iterable[str]) -> list[Entry]:
    """Everything in the stages' folders that may be deleted."""
    entries, busy = [], in_use(store.out)
    for stage in stages:
        found = [e for path in store.own_entries(stage) if (e := _entry(path, stage)) is not None]
        artifacts = [e for e in found if e.kind == "artifact"]
        newest = max(artifacts, key=lambda e: e.used, default=None)
        entries += [Entry(e.path, e.stage, e.kind, e.size, e.used, e is newest, e.name in busy) for e in found]
    return entries


def choose(entries: Iterable[Entry], keep: int | None = None, older: float | None = None, now: float | None = None) -> list[Entry]:
    """The entries to delete, of those that no run uses.

    Temporary folders and leases without a live holder: always. Artifacts, checkpoints and caches: those unused for `older` seconds, except
    the newest artifact of each stage; then, least recently used first, until at most `keep` bytes are left.
    """
    entries, now = list(entries), time.time() if now is None else now
    chosen = [e for e in entries if e.kind in ("temporary folder", "lease")]
    rest = sorted((e for e in entries if e.kind in ("artifact", "checkpoint", "cache")), key=lambda e: (e.newest, e.used))
    free = [e for e in rest if not e.in_use]
    if older is not None:
        chosen += [e for e in free if not e.newest and now - e.used > older]
    if keep is not None:
        left = [e for e in free if e not in chosen]
        total = sum(e.size for e in rest if e not in chosen)
        while left and total > keep:
            chosen.append(left.pop(0))
            total -= chosen[-1].size
    return chosen


def delete(store: Store, entries: Iterable[Entry]) -> list[Entry]:
    """Delete the entries that no process works on or uses; returns those that were deleted."""
    done = []
    forget_killed(store.out)
    for entry in entries:
        lease = lease_path(entry.path)
        holder = LeaseHolder.read(lease)
        if holder is not None and holder.alive() is not False:
            continue
        held = Lease(lease)
        held.acquire()
        try:
            if entry.path.is_dir() and entry.name not in in_use(store.out):  # a lease file goes with the lease's release
                if entry.kind == "artifact":
                    store.set_aside_changed(entry.path)  # what was edited there is the user's
                remove_tree(entry.path)
        finally:
            held.release()
        if not entry.path.exists():
            done.append(entry)
    return done


def _entry(path: Path, stage: str) -> Entry | None:
    if path.is_dir():
        kind = next((kind for kind, pattern in _KINDS if pattern.fullmatch(path.name)), None)
    else:
        kind = "lease" if _LEASE.fullmatch(path.name) else None
    if kind is None:
        return None
    status = path.stat()
    return Entry(path, stage, kind, status.st_size if kind == "lease" else _tree_size(path), status.st_mtime)


def _tree_size(folder: Path) -> int:
    total = 0
    for root, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(root, name)).st_size
    return total
