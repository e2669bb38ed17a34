"""Leases: who is computing an artifact now, and when that claim has lapsed.

Two layers. A kernel file lock (filelock) excludes other processes on this machine and falls with its process. Beside it lies a
lease file {host, boot, pid, started, beat}: it tells a person who holds the lease, and keeps machines apart that share the folder
over a network where locks may not carry. No state "running" is ever stored that somebody would have to clear: a lease lapses when
its process is gone (same boot: pid and start time are looked up; same host, other boot: gone for certain) or, on another host,
when its heartbeat has stood still while we watched — so clocks need not agree.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil
from filelock import FileLock, Timeout

from gsbake.pipeline.files import write_atomic

#: Seconds between heartbeats, and how long one may stand still before another host's lease counts as lapsed.
BEAT = 5.0
PATIENCE = 30.0


@dataclass(frozen=True)
class Holder:
    """The process behind a lease."""

    host: str
    boot: str
    pid: int
    started: float
    beat: int = 0

    @staticmethod
    def me() -> Holder:
        """This process."""
        return Holder(socket.gethostname(), boot_id(), os.getpid(), psutil.Process().create_time())

    @staticmethod
    def read(path: Path) -> Holder | None:
        """The holder a lease file names; None when there is none or it is unreadable."""
        try:
            body = json.loads(path.read_text())
            return Holder(str(body["host"]), str(body["boot"]), int(body["pid"]), float(body["started"]), int(body["beat"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def alive(self) -> bool | None:
        """Whether the process runs; None when that cannot be told from here."""
        if self.host != socket.gethostname():
            return None
        if self.boot != boot_id():
            return False
        try:
            return abs(psutil.Process(self.pid).create_time() - self.started) < 1.0
        except psutil.NoSuchProcess:
            return False
        except psutil.AccessDenied:
            return True

    def __str__(self) -> str:
        since = time.strftime("%H:%M:%S", time.localtime(self.started))
        return f"process {self.pid} on {self.host}, started {since}"


class Lease:
    """The right to compute one artifact; use `acquire` … `release`, or as a context manager after `acquire`."""

    def __init__(self, path: Path, *, beat: float = BEAT, patience: float = PATIENCE) -> None:
        self.path = path
        self._beat, self._patience = beat, patience
        self._lock = FileLock(path.with_name(f".{path.name}.lock"), thread_local=False, preserve_lock_file=True)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def acquire(self, on_wait: Callable[[Holder | None], None] | None = None, poll: float = 0.2) -> Holder | None:
        """Take the lease, waiting for a live holder; returns the lapsed holder it was taken over from, if any.

        `on_wait` is called at every poll while somebody else holds the lease; it may raise to give up.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        seen: Holder | None = None
        since = time.monotonic()
        while True:
            holder = Holder.read(self.path)
            if holder != seen:
                seen, since = holder, time.monotonic()
            try:
                self._lock.acquire(timeout=0)
            except Timeout:
                pass
            else:
                holder = Holder.read(self.path)
                if self._lapsed(holder, seen, since):
                    self._start()
                    return holder
                self._lock.release()
            if on_wait is not None:
                on_wait(holder)
            time.sleep(poll)

    def _lapsed(self, holder: Holder | None, seen: Holder | None, since: float) -> bool:
        """Whether nobody holds the lease, given that we hold the kernel lock."""
        if holder is None or (holder.pid == os.getpid() and holder.alive()):
            return True
        alive = holder.alive()
        if alive is None:
            return holder == seen and time.monotonic() - since > self._patience
        return not alive

    def _start(self) -> None:
        me = Holder.me()
        self._write(me, 0)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(me,), name="lease heartbeat", daemon=True)
        self._thread.start()

    def _run(self, me: Holder) -> None:
        beat = 0
        while not self._stop.wait(self._beat):
            beat += 1
            with suppress(OSError):  # a full disk must not take the lease away: the kernel lock still stands
                self._write(me, beat)

    def _write(self, me: Holder, beat: int) -> None:
        write_atomic(self.path, json.dumps({**asdict(me), "beat": beat}))

    def release(self) -> None:
        """Give the lease back."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            with suppress(OSError):
                self.path.unlink()
        self._lock.release()

    def __enter__(self) -> Lease:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def boot_id() -> str:
    """An identifier of this boot of the machine."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"boot-{psutil.boot_time():.0f}"
