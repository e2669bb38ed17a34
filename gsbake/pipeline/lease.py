"""Leases: exclusive rights to compute an artifact, with detection of stale ones.

Two layers: a kernel file lock (filelock) excludes other processes of this machine and is released when its process ends. A lease file
{host, boot, pid, started, beat} names the holder and excludes other machines that share the folder over a network, where locks may not
work. A lease needs no manual clean-up. It is stale when its process has ended (same boot: pid and start time are compared; same host,
other boot: always) or, on another host, when its heartbeat counter has not changed during the timeout, so clocks need not agree.
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

#: Seconds between heartbeats, and seconds without one after which another host's lease is stale.
HEARTBEAT_INTERVAL = 5.0
HEARTBEAT_TIMEOUT = 30.0


@dataclass(frozen=True)
class LeaseHolder:
    """The process that holds a lease; `started` is its start time in seconds since the epoch, `beat` the heartbeat counter."""

    host: str
    boot: str
    pid: int
    started: float
    beat: int = 0

    @staticmethod
    def current() -> LeaseHolder:
        """This process."""
        return LeaseHolder(socket.gethostname(), boot_id(), os.getpid(), psutil.Process().create_time())

    @staticmethod
    def read(path: Path) -> LeaseHolder | None:
        """The holder named in a lease file; None when the file is missing or unreadable."""
        try:
            body = json.loads(path.read_text())
            return LeaseHolder(str(body["host"]), str(body["boot"]), int(body["pid"]), float(body["started"]), int(body["beat"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def alive(self) -> bool | None:
        """Whether the process runs; None when it is on another host."""
        if self.host != socket.gethostname():
            return None
        if self.boot != boot_id():
            return False
        try:
            return bool(abs(psutil.Process(self.pid).create_time() - self.started) < 1.0)
        except psutil.NoSuchProcess:
            return False
        except psutil.AccessDenied:
            return True

    def __str__(self) -> str:
        since = time.strftime("%H:%M:%S", time.localtime(self.started))
        return f"process {self.pid} on {self.host}, started {since}"


class Lease:
    """Exclusive right to compute one artifact. After `acquire`, call `release` or use it as a context manager."""

    def __init__(self, path: Path, *, heartbeat_interval: float = HEARTBEAT_INTERVAL, heartbeat_timeout: float = HEARTBEAT_TIMEOUT) -> None:
        self.path = path
        self._interval, self._timeout = heartbeat_interval, heartbeat_timeout
        self._lock = FileLock(path.with_name(f".{path.name}.lock"), thread_local=False, preserve_lock_file=True)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def acquire(self, on_wait: Callable[[LeaseHolder | None], None] | None = None, poll: float = 0.2) -> LeaseHolder | None:
        """Acquire the lease; waits while another process holds it. Returns the holder of a stale lease that was taken over, if any.

        `on_wait` is called at every poll (every `poll` seconds) while waiting; it may raise to cancel.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        last: LeaseHolder | None = None
        last_change = time.monotonic()
        while True:
            holder = LeaseHolder.read(self.path)
            if holder != last:
                last, last_change = holder, time.monotonic()
            try:
                self._lock.acquire(timeout=0)
            except Timeout:
                pass
            else:
                holder = LeaseHolder.read(self.path)
                if self._is_stale(holder, last, last_change):
                    self._start()
                    return holder
                self._lock.release()
            if on_wait is not None:
                on_wait(holder)
            time.sleep(poll)

    def _is_stale(self, holder: LeaseHolder | None, last: LeaseHolder | None, last_change: float) -> bool:
        """Whether the lease is free, given that this process holds the kernel lock."""
        if holder is None or (holder.pid == os.getpid() and holder.alive()):
            return True
        alive = holder.alive()
        if alive is None:
            return holder == last and time.monotonic() - last_change > self._timeout
        return not alive

    def _start(self) -> None:
        holder = LeaseHolder.current()
        self._write(holder, 0)
        self._stop.clear()
        self._thread = threading.Thread(target=self._send_heartbeats, args=(holder,), name="lease heartbeat", daemon=True)
        self._thread.start()

    def _send_heartbeats(self, holder: LeaseHolder) -> None:
        beat = 0
        while not self._stop.wait(self._interval):
            beat += 1
            with suppress(OSError):  # a full disk must not end the lease: the kernel lock is still held
                self._write(holder, beat)

    def _write(self, holder: LeaseHolder, beat: int) -> None:
        write_atomic(self.path, json.dumps({**asdict(holder), "beat": beat}))

    def release(self) -> None:
        """Release the lease and delete its file."""
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
    """Identifier of the machine's current boot."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"boot-{psutil.boot_time():.0f}"
