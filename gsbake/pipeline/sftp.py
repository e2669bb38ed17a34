"""SFTP for the shared store: fsspec's file system, with the server's identity checked and a lost connection made anew.

fsspec accepts any key that a server shows, and what a shared store holds ends in other machines' assets; here the key must be in
`~/.ssh/known_hosts`, as for `ssh`. Only imported for `sftp://`, because paramiko is optional.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import paramiko
from fsspec.implementations.sftp import SFTPFileSystem

from gsbake.errors import UsageError

#: Seconds for the connection, and for each answer afterwards.
_TIMEOUT = 30.0
_SYSTEM_KEYS = Path("/etc/ssh/ssh_known_hosts")


class _KnownHostsOnly(paramiko.MissingHostKeyPolicy):  # type: ignore[misc]  # paramiko has no types
    """Refuses a server whose key is not known, with what to do."""

    def missing_host_key(self, client: Any, hostname: str, key: Any) -> None:
        raise UsageError(
            f"The key of the SFTP server {hostname} ({key.get_name()}) is not in ~/.ssh/known_hosts; connect once with ssh and compare it."
        )


class SftpStore(SFTPFileSystem):  # type: ignore[misc]  # fsspec has no types
    """fsspec's SFTP file system with known hosts only, time limits, and `reconnect`."""

    def _connect(self) -> None:
        self.client = paramiko.SSHClient()
        self.client.load_system_host_keys()
        with suppress(OSError):
            self.client.load_system_host_keys(str(_SYSTEM_KEYS))
        self.client.set_missing_host_key_policy(_KnownHostsOnly())
        try:
            self.client.connect(self.host, timeout=_TIMEOUT, banner_timeout=_TIMEOUT, auth_timeout=_TIMEOUT, **self.ssh_kwargs)
        except paramiko.BadHostKeyException as error:
            raise UsageError(
                f"The SFTP server {self.host} shows another key than ~/.ssh/known_hosts has for it; ask its owner before you trust it."
            ) from error
        self.ftp = self.client.open_sftp()
        self.ftp.get_channel().settimeout(_TIMEOUT)

    def reconnect(self) -> None:
        """Make the connection anew. Raises what paramiko raises when the server does not answer."""
        self.client.close()
        self._connect()

    def mv(self, old: str, new: str) -> None:
        """Rename a file; an existing one is replaced, at once where the server can (OpenSSH does)."""
        try:
            super().mv(old, new)
        except OSError:
            with suppress(FileNotFoundError):
                self.ftp.remove(new)
            self.ftp.rename(old, new)
