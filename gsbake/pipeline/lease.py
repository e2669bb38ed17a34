"""Leases: exclusive rights to compute an artifact, with detection of stale ones.

Two layers. A kernel file lock (filelock) excludes other processes of this machine and is released when its process ends. A lease file
{host, boot, pid, started, token, beat} names the holder and excludes other machines that share the folder over a network, where locks may
not work. The lease file is created by a hard link, which fails where one exists (atomic on network folders too), and read again after a
moment; a stale file is moved away first, and put back when it is not the one that was judged stale. The token is a fencing token: before
publishing, the holder checks that the file still holds it.

A lease needs no manual clean-up. It is stale when its process has ended (same host and boot: process id and start time are compared) or,
from another host or boot, when its heartbeat counter has not changed during the timeout; clocks need not agree. Machines cloned with one
host name differ in their boot identifier. A process that is suspended for longer than the timeout may lose its lease; it then discards
its result.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil
from filelock import FileLock, Timeout

from gsbake.atomic import write_atomic
from gsbake.system import disk
from gsbake.system.limits import boot_id

#: Seconds between heartbeats, and seconds without one after which the lease of another host or boot is stale.
HEARTBEAT_INTERVAL = 5.0
HEARTBEAT_TIMEOUT = 30.0
#: Seconds after which a new lease file is read again; longer than a network folder takes to show a rename.
SETTLE_TIME = 0.05


@dataclass(frozen=True)
class LeaseHolder:
    """The process that holds a lease; `started` is its start time in seconds since the epoch, `beat` the heartbeat counter."""

    host: str
    boot: str
    pid: int
    started: float
    beat: int = 0
    token: str = ""

    @staticmethod
    def current() -> LeaseHolder:
        """This process, with a new token."""
        return LeaseHolder(socket.gethostname(), boot_id(), os.getpid(), psutil.Process().create_time(), token=uuid.uuid4().hex)

    @staticmethod
    def read(path: Path) -> LeaseHolder | None:
        """The holder named in a lease file; None when the file is missing or unreadable."""
        try:
            body = json.loads(disk.read(path))
            return LeaseHolder(
                str(body["host"]), str(body["boot"]), int(body["pid"]), float(body["started"]), int(body["beat"]), str(body["token"])
            )
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None

    def alive(self) -> bool | None:
        """Whether the process runs; None when it belongs to another host or boot, which only its heartbeat tells."""
        if self.host != socket.gethostname() or self.boot != boot_id():
            return None
        try:
            return bool(abs(psutil.Process(self.pid).create_time() - self.started) < 1.0)
        except (psutil.NoSuchProcess, ValueError, OverflowError):
            return False
        except psutil.AccessDenied:
            return True

    def __str__(self) -> str:
        with suppress(ValueError, OverflowError, OSError):
            return f"process {self.pid} on {self.host}, started {time.strftime('%H:%M:%S', time.localtime(self.started))}"
        return f"process {self.pid} on {self.host}"


class Lease:
    """Exclusive right to compute one artifact. After `acquire`, call `release` or use it as a context manager."""

    def __init__(self, path: Path, *, heartbeat_interval: float = HEARTBEAT_INTERVAL, heartbeat_timeout: float = HEARTBEAT_TIMEOUT) -> None:
        self.path = path
        self._interval, self._timeout = heartbeat_interval, heartbeat_timeout
        self._lock = FileLock(path.with_name(f".{path.name}.lock"), thread_local=False, preserve_lock_file=True)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._holder: LeaseHolder | None = None

    @property
    def token(self) -> str:
        """Fencing token of the acquired lease; empty before."""
        return "" if self._holder is None else self._holder.token

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
                try:
                    holder = LeaseHolder.read(self.path)
                    taken = self._is_stale(holder, last, last_change) and self._take(holder)
                except BaseException:
                    self._lock.release()
                    raise
                if taken:
                    self._start_heartbeats()
                    return holder
                self._lock.release()
            if on_wait is not None:
                on_wait(holder)
            time.sleep(poll)

    def held(self) -> bool:
        """Whether the lease file still names this holder."""
        found = LeaseHolder.read(self.path)
        return found is not None and found.token == self.token != ""

    def _is_stale(self, holder: LeaseHolder | None, last: LeaseHolder | None, last_change: float) -> bool:
        """Whether the lease is free, given that this process holds the kernel lock."""
        if holder is None or (holder.pid == os.getpid() and holder.alive()):
            return True
        alive = holder.alive()
        if alive is None:
            return holder == last and time.monotonic() - last_change > self._timeout
        return not alive

    def _take(self, stale: LeaseHolder | None) -> bool:
        """Replace the stale lease file by one of this process; False when another process was faster."""
        if self.path.exists() and not self._move_away(stale):
            return False
        holder = LeaseHolder.current()
        temporary = self.path.with_name(f".{self.path.name}.{holder.token}.tmp")
        try:
            temporary.write_bytes(json.dumps(asdict(holder)).encode())
            _link(temporary, self.path)
        except (FileExistsError, FileNotFoundError):  # another holder, which may also have cleaned up
            return False
        finally:
            temporary.unlink(missing_ok=True)
        time.sleep(SETTLE_TIME)
        self._holder = holder
        if self.held():
            return True
        self._holder = None
        return False

    def _move_away(self, stale: LeaseHolder | None) -> bool:
        """Remove the lease file if it is (still) the stale one."""
        aside = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}.tmp")
        try:
            disk.replace(self.path, aside)
        except FileNotFoundError:
            return True
        found = LeaseHolder.read(aside)
        if found != stale:  # another process has taken it over meanwhile
            with suppress(FileExistsError, FileNotFoundError):
                _link(aside, self.path)
        aside.unlink(missing_ok=True)
        return found == stale

    def _start_heartbeats(self) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=self._send_heartbeats, name="lease heartbeat", daemon=True)
        self._thread.start()

    def _send_heartbeats(self) -> None:
        beat = 0
        assert self._holder is not None
        while not self._stop.wait(self._interval):
            beat += 1
            if not self.held():  # taken over: a heartbeat would steal it back
                return
            with suppress(OSError):  # a full disk must not end the lease: the kernel lock is still held
                write_atomic(self.path, json.dumps({**asdict(self._holder), "beat": beat}))

    def release(self) -> None:
        """Release the lease, and delete its file if it is still this holder's."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            with suppress(OSError):
                if self.held():
                    self.path.unlink()
            self._holder = None
        self._lock.release()

    def __enter__(self) -> Lease:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def _link(source: Path, target: Path) -> None:
    """Create `target` with the content of `source`. Raises FileExistsError when there is one, FileNotFoundError without a source."""
    try:
        disk.link(source, target)
    except (FileExistsError, FileNotFoundError):
        raise
    except OSError:  # a file system without hard links: exclusive creation is the next best
        with target.open("x", encoding="utf-8") as file:
            file.write(source.read_text(encoding="utf-8"))
