"""OpenStack Swift on loopback, with its S3 interface: an object server that keeps its objects on the disk, so that it can be killed in the
middle of a put and started again. (moto, which other tests use, keeps them in memory.)

Debian's packages are enough: `apt-get install swift-proxy swift-account swift-container swift-object memcached`. One copy of each object,
one process per service, in a folder and on free ports. Swift reads /etc/swift only, so it runs in a mount namespace of its own, which
needs root.
"""

from __future__ import annotations

import os
import shlex
import shutil
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path

_CONFIG_FOLDER = Path("/etc/swift")
_STORAGE = ("account", "container", "object")
_PROGRAMS = ("swift-proxy-server", *(f"swift-{name}-server" for name in _STORAGE), "swift-ring-builder", "memcached")
_START_TIMEOUT = 90.0
_STORAGE_CONFIG = """\
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
workers = 0
user = root
devices = {folder}/devices
mount_check = false
swift_dir = /etc/swift
[pipeline:main]
pipeline = {name}-server
[app:{name}-server]
use = egg:swift#{name}
"""
_PROXY_CONFIG = """\
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
workers = 0
user = root
swift_dir = /etc/swift
[pipeline:main]
pipeline = catch_errors proxy-logging cache listing_formats s3api tempauth copy slo dlo proxy-logging proxy-server
[app:proxy-server]
use = egg:swift#proxy
account_autocreate = true
allow_account_management = true
[filter:catch_errors]
use = egg:swift#catch_errors
[filter:proxy-logging]
use = egg:swift#proxy_logging
[filter:cache]
use = egg:swift#memcache
memcache_servers = 127.0.0.1:{cache}
[filter:listing_formats]
use = egg:swift#listing_formats
[filter:s3api]
use = egg:swift#s3api
[filter:tempauth]
use = egg:swift#tempauth
user_test_tester = testing .admin
[filter:copy]
use = egg:swift#copy
[filter:slo]
use = egg:swift#slo
[filter:dlo]
use = egg:swift#dlo
"""


class ServerUnavailable(Exception):
    """The server cannot be started on this machine; the message says why."""


class SwiftServer:
    """The server in `folder`; a context manager that starts and stops it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.port = 0
        self._processes: list[subprocess.Popen[bytes]] = []
        self._commands: list[tuple[str, ...]] = []

    @property
    def environment(self) -> dict[str, str]:
        """Variables with which s3fs reaches the server."""
        keys = {"AWS_ACCESS_KEY_ID": "test:tester", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1"}
        return {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}", **keys}

    def __enter__(self) -> SwiftServer:
        missing = [name for name in _PROGRAMS if shutil.which(name) is None]
        if missing:
            packages = ", ".join(("swift-proxy", *(f"swift-{name}" for name in _STORAGE), "memcached"))
            raise ServerUnavailable(f"{missing[0]} not found (Debian: {packages})")
        if os.geteuid() != 0 or subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False).returncode:
            raise ServerUnavailable("Swift needs root and mount namespaces")
        self._configure()
        try:
            self.start()
        except BaseException:
            self.kill()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self) -> None:
        """Start all services and wait until they answer. Raises ServerUnavailable."""
        for command in self._commands:
            script = f"mount --bind {shlex.quote(str(self.folder / 'etc'))} {_CONFIG_FOLDER} && exec {shlex.join(command)}"
            with (self.folder / "log").open("ab") as log:
                self._processes.append(
                    subprocess.Popen(["unshare", "--mount", "sh", "-c", script], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
                )
        deadline = time.monotonic() + _START_TIMEOUT
        while not self._answers():
            if time.monotonic() > deadline or any(process.poll() is not None for process in self._processes):
                raise ServerUnavailable(f"Swift does not start: {(self.folder / 'log').read_text(errors='replace')[-800:]}")
            time.sleep(0.2)

    def kill(self) -> None:
        """Kill all services at once, as a power failure does; what was stored stays."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()
        self._processes.clear()

    def _answers(self) -> bool:
        for port in self._ports:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                continue
            return False
        return True

    def _configure(self) -> None:
        etc = self.folder / "etc"
        for path in (etc, self.folder / "devices" / "disk"):
            path.mkdir(parents=True)
        self._ports = _free_ports(2 + len(_STORAGE))
        self.port, cache = self._ports[:2]
        (etc / "swift.conf").write_text("[swift-hash]\nswift_hash_path_suffix = gsbake\n[storage-policy:0]\nname = one\ndefault = yes\n")
        (etc / "proxy-server.conf").write_text(_PROXY_CONFIG.format(port=self.port, cache=cache))
        self._commands = [("memcached", "-u", "root", "-l", "127.0.0.1", "-p", str(cache))]
        for name, port in zip(_STORAGE, self._ports[2:], strict=True):
            (etc / f"{name}-server.conf").write_text(_STORAGE_CONFIG.format(name=name, port=port, folder=self.folder))
            for words in (("create", "4", "1", "0"), ("add", f"r1z1-127.0.0.1:{port}/disk", "1"), ("rebalance",)):
                subprocess.run(["swift-ring-builder", f"{name}.builder", *words], cwd=etc, check=True, capture_output=True)
            self._commands.append((f"swift-{name}-server", f"/etc/swift/{name}-server.conf"))
        self._commands.append(("swift-proxy-server", "/etc/swift/proxy-server.conf"))


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for entry in sockets:
            entry.bind(("127.0.0.1", 0))
        return [int(entry.getsockname()[1]) for entry in sockets]
    finally:
        for entry in sockets:
            entry.close()
