"""Uses: which artifacts the runs in progress read, so that no garbage collection deletes them.

A lease protects an artifact while it is computed. Later stages read it after that, so each run names what it has reused and computed in a
file of its own, OUT/running/<id>.json, until it ends. It names an artifact first and then looks at its lease; who deletes takes the lease
first and then looks at the files. So at least one of the two sees the other. A file is stale when its process has ended or, on another
host or boot, when it has not been written to for an hour.
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
import uuid
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType

from gsbake.atomic import write_atomic
from gsbake.pipeline.lease import HEARTBEAT_INTERVAL, LeaseHolder
from gsbake.pipeline.store import lease_path

FOLDER = "running"
_NAME = re.compile(r"[0-9a-f]{32}\.json")
#: Name of such a file while it is written.
_HALF_WRITTEN = re.compile(r"\.[0-9a-f]{32}\.json\.[0-9]+\.[0-9a-f]{8}\.tmp")
#: Seconds after which a file of another host, whose clock may differ, is stale.
_FORGOTTEN = 3600.0
#: Times that the folder is made, which another run may delete when it ends.
_TRIES = 5


class Uses:
    """The artifacts that a run uses, from the first `with` to the end of the last; it may be entered again inside."""

    def __init__(self, out: Path) -> None:
        self._path = out / FOLDER / f"{uuid.uuid4().hex}.json"
        self._names: list[str] = []
        self._depth = 0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Uses:
        self._depth += 1
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._depth -= 1
        if self._depth:
            return
        if self._thread is not None:
            self._stop.set()
            self._thread.join()
            self._thread = None
        self._names = []
        with suppress(OSError):
            self._path.unlink()
        with suppress(OSError):
            self._path.parent.rmdir()  # succeeds only when no other run is in progress

    def add(self, folder: Path) -> bool:
        """Note that a run uses an artifact; False when another process has its lease, and so may be about to delete or to replace it."""
        self._names.append(f"{folder.parent.name}/{folder.name}")
        self._write()
        if self._thread is None:
            self._stop.clear()
            self._thread = threading.Thread(target=self._send_heartbeats, name="uses heartbeat", daemon=True)
            self._thread.start()
        holder = LeaseHolder.read(lease_path(folder))
        return holder is None or holder.pid == os.getpid() or holder.alive() is False

    def _write(self) -> None:
        text = json.dumps({**asdict(LeaseHolder.current()), "uses": self._names})
        with self._lock, suppress(OSError):  # a full disk ends the run elsewhere, with a sentence
            for _ in range(_TRIES):
                with suppress(FileNotFoundError):
                    self._path.parent.mkdir(exist_ok=True)
                    write_atomic(self._path, text)
                    return

    def _send_heartbeats(self) -> None:
        while not self._stop.wait(HEARTBEAT_INTERVAL):
            self._write()


def in_use(out: Path) -> frozenset[str]:
    """The artifacts, as "<stage>/<folder>", that runs in progress use."""
    found: set[str] = set()
    for path in _files(out, _NAME):
        with suppress(OSError, ValueError, RecursionError):
            names = json.loads(path.read_bytes()).get("uses", [])
            if not _is_stale(path):
                found.update(str(name) for name in names)
    return frozenset(found)


def forget_killed(out: Path) -> None:
    """Delete the files of runs that were killed."""
    for path in (*_files(out, _NAME), *_files(out, _HALF_WRITTEN)):
        if _is_stale(path):
            path.unlink(missing_ok=True)


def _files(out: Path, pattern: re.Pattern[str]) -> list[Path]:
    folder = out / FOLDER
    with suppress(OSError):
        return [path for path in folder.iterdir() if pattern.fullmatch(path.name) and not folder.is_symlink() and not path.is_symlink()]
    return []


def _is_stale(path: Path) -> bool:
    holder = LeaseHolder.read(path)
    alive = None if holder is None else holder.alive()
    try:
        return alive is False or (alive is None and time.time() - path.stat().st_mtime > _FORGOTTEN)
    except OSError:
        return False
