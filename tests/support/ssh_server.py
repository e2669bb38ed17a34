"""OpenSSH's server on loopback for SFTP, with keys of its own, in a folder and on a free port (Debian: openssh-server)."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import psutil

_START_TIMEOUT = 30.0
_CONFIG = """\
Port {port}
ListenAddress 127.0.0.1
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/home/.ssh/id_ed25519.pub
PidFile none
StrictModes no
UsePAM no
PermitRootLogin yes
PasswordAuthentication no
Subsystem sftp internal-sftp
"""


class ServerUnavailable(Exception):
    """The server cannot be started on this machine; the message says why."""


class SshServer:
    """The server in `folder`; `home` is a home folder whose user may log in and knows the server."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.home = self.folder / "home"
        self.port = 0
        self._process: subprocess.Popen[bytes] | None = None

    def url(self, path: Path) -> str:
        """URL of a folder on the server."""
        import getpass

        return f"sftp://{getpass.getuser()}@127.0.0.1:{self.port}{path}"

    def __enter__(self) -> SshServer:
        self._program = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin")
        if self._program is None or shutil.which("ssh-keygen") is None:
            raise ServerUnavailable("sshd not found (Debian: openssh-server)")
        keys = self.home / ".ssh"
        keys.mkdir(parents=True)
        for path in (self.folder / "host_key", keys / "id_ed25519"):
            subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(path)], check=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        (keys / "known_hosts").write_text(f"[127.0.0.1]:{self.port} {(self.folder / 'host_key.pub').read_text()}")
        (self.folder / "sshd_config").write_text(_CONFIG.format(port=self.port, folder=self.folder))
        if os.geteuid() == 0:
            Path("/run/sshd").mkdir(exist_ok=True)  # sshd refuses to start as root without it
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self) -> None:
        """Start the server and wait until it answers. Raises ServerUnavailable."""
        assert self._program is not None
        log = self.folder / "log"
        self._process = subprocess.Popen([self._program, "-D", "-f", str(self.folder / "sshd_config"), "-E", str(log)])
        deadline = time.monotonic() + _START_TIMEOUT
        while True:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0):
                return
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise ServerUnavailable(f"sshd does not start: {log.read_text(errors='replace')[-500:] if log.exists() else ''}")
            time.sleep(0.1)

    def kill(self) -> None:
        """Kill the server and its connections."""
        if self._process is None:
            return
        with suppress(psutil.Error):
            for child in psutil.Process(self._process.pid).children(recursive=True):
                with suppress(psutil.Error):
                    child.send_signal(signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        self._process = None
