"""Files of a shared store, by their names in it, through fsspec: patiently, of gsbake's own names only, and never through a link.

What has another name may be anybody's: it is neither read nor written nor deleted here. A link inside a store may lead out of it, so links
and what lies behind them count as missing, and nothing is written there.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from gsbake.errors import GsbakeError
from gsbake.own_files import FILE_MANAGER_FILES
from gsbake.pipeline.files import DISK_FULL, LASTING, NOT_WRITABLE
from gsbake.pipeline.store_url import hide_credentials
from gsbake.system import disk

#: File that marks a folder as a store, and holds its quota.
MARKER = "store.json"
#: Folders of a store: manifests of artifacts, files by their digests, incomplete uploads.
ENTRIES, BLOBS, UPLOADS = "ac", "cas", "tmp"
#: fsspec protocols whose writes are atomic: an object is there whole or not at all.
OBJECT_STORES = frozenset({"s3", "s3a", "memory"})
_NAME = re.compile(
    rf"{re.escape(MARKER)}|{ENTRIES}/[A-Za-z0-9_][A-Za-z0-9_.-]{{0,99}}/[0-9a-f]{{64}}\.json"
    rf"|{BLOBS}/([0-9a-f]{{2}})/\1[0-9a-f]{{62}}|{UPLOADS}/[0-9a-f]{{32}}"
)
_T = TypeVar("_T")


class StoreUnreachableError(Exception):
    """The shared store did not answer in time, or cannot be used; the message says what it answered last."""


@dataclass(frozen=True)
class Properties:
    """Size in bytes and time of the last change, in seconds since the epoch, of a file in a store."""

    size: int
    modified: float


def is_store_name(name: str) -> bool:
    """Whether gsbake gives a file in a store this name."""
    return _NAME.fullmatch(name) is not None


class StoreFiles:
    """The files under one folder or prefix. All methods raise StoreUnreachableError, and PermissionError where the store refuses."""

    def __init__(self, system: Any, root: str, protocol: str, patience: float, url: str) -> None:
        self.system = system
        self.local = protocol in ("file", "local")
        self._root, self._patience, self._objects, self._address = root, patience, protocol in OBJECT_STORES, url
        self._plain: set[str] = set()

    def path(self, name: str) -> str:
        """The path that the file system knows the file by. Raises ValueError for a name that gsbake does not give."""
        if not is_store_name(name):
            raise ValueError(f"not a name in a shared store: {name!r}")
        return f"{self._root}/{name}"

    # -- looking ---------------------------------------------------------------------------------------------------------------------------

    def top(self) -> list[str]:
        """Names in the store's folder itself, whoever gave them; none where there is no folder. Raises NotADirectoryError."""
        root = self._root or "/"
        try:
            if not self._objects and self.patiently(lambda: self.system.info(root))["type"] != "directory":
                raise NotADirectoryError("it is a file")
            found = self.patiently(lambda: self.system.ls(root, detail=False))
        except FileNotFoundError:
            return []
        names = {str(path).rstrip("/").rsplit("/", 1)[-1] for path in found if str(path).strip("/") != root.strip("/")}
        return sorted(names - FILE_MANAGER_FILES)

    def status(self, name: str, check: Callable[[], None] = lambda: None) -> Properties | None:
        """Properties of a file; None where there is none, or only a link, or a folder, or something behind a link."""
        path = self.path(name)
        try:
            if self._objects:
                info = self.patiently(lambda: self.system.info(path), check)
                return _properties(info)
            if not self.is_plain(name.rpartition("/")[0]):
                return None
            found = self._lstat(path)
        except (FileNotFoundError, NotADirectoryError):
            return None
        return Properties(int(found.st_size), float(found.st_mtime)) if stat.S_ISREG(found.st_mode) else None

    def is_plain(self, folder: str) -> bool:
        """Whether a folder of the store ("cas/ab") is one, and neither a link nor behind one. Raises FileNotFoundError."""
        parts = folder.split("/") if folder and not self._objects else []
        for name in ("/".join(parts[:count]) for count in range(1, len(parts) + 1)):
            if name not in self._plain:
                if not stat.S_ISDIR(self._lstat(f"{self._root}/{name}").st_mode):
                    return False
                self._plain.add(name)
        return True

    def find(self, folder: str) -> dict[str, Properties]:
        """{name: properties} of the files of gsbake's names in a folder of the store."""
        return {name: found for name, found in self.walk(folder) if found is not None and is_store_name(name)}

    def walk(self, folder: str) -> Iterator[tuple[str, Properties | None]]:
        """(name, properties) of everything in a folder of the store; no properties of links, folders two levels down and the like."""
        if self._objects:
            with suppress(FileNotFoundError):
                root = f"{self._root}/{folder}"
                for path, info in self.patiently(lambda: self.system.find(root, detail=True)).items():
                    yield path.removeprefix(f"{self._root}/"), _properties(info)
            return
        with suppress(FileNotFoundError):
            if self.is_plain(folder):
                yield from self._walk(folder, 1)

    def _walk(self, folder: str, levels: int) -> Iterator[tuple[str, Properties | None]]:
        found: list[tuple[str, Any]] = []
        with suppress(FileNotFoundError):  # deleted meanwhile
            found = self.patiently(lambda: self._list(f"{self._root}/{folder}"))
        for name, status in found:
            if name in FILE_MANAGER_FILES:
                continue
            if levels and stat.S_ISDIR(status.st_mode):
                yield from self._walk(f"{folder}/{name}", levels - 1)
            else:
                regular = stat.S_ISREG(status.st_mode)
                yield f"{folder}/{name}", Properties(int(status.st_size), float(status.st_mtime)) if regular else None

    def _list(self, path: str) -> list[tuple[str, Any]]:
        """(name, status) of what is in a folder, of links themselves."""
        if not self.local:
            return [(entry.filename, entry) for entry in self.system.ftp.listdir_attr(path)]
        found = []
        with os.scandir(path) as entries:
            for entry in entries:
                with suppress(FileNotFoundError):
                    found.append((entry.name, entry.stat(follow_symlinks=False)))
        return found

    def _lstat(self, path: str) -> Any:
        return self.patiently(lambda: os.lstat(path) if self.local else self.system.ftp.lstat(path))

    # -- reading and writing ---------------------------------------------------------------------------------------------------------------

    def read(self, name: str, check: Callable[[], None] = lambda: None) -> bytes:
        """The bytes of a file. Raises FileNotFoundError. Ask for its `status` first, which says how large it is."""
        path = self.path(name)
        content: bytes = self.patiently(lambda: self.system.cat_file(path), check)
        return content

    def download(self, name: str, target: Path, check: Callable[[], None] = lambda: None) -> None:
        """Copy a file to `target`. Raises FileNotFoundError. Ask for its `status` first."""
        path = self.path(name)
        self.patiently(lambda: self.system.get_file(path, str(target)), check)

    def delete(self, name: str) -> None:
        """Delete a file if it is there."""
        if self.status(name) is not None:
            with suppress(FileNotFoundError):
                self.patiently(lambda: self.system.rm_file(self.path(name)))

    def mark_used(self, name: str) -> None:
        """Set a file's time to now, where the store is a folder."""
        if self.local:
            with suppress(OSError):
                os.utime(self.path(name))

    def create(self, name: str, content: bytes) -> None:
        """Write a small file directly in the store's folder, and the folder where it is missing; one that is there stays."""
        path = self.path(name)
        if not self._objects:
            self.patiently(lambda: self.system.makedirs(self._root, exist_ok=True))
        if not self.local:
            self.patiently(lambda: self.system.pipe_file(path, content))
            return
        with suppress(FileExistsError):
            with Path(path).open("xb") as file:
                file.write(content)
            disk.sync(Path(path))

    def write(self, source: Path, name: str, check: Callable[[], None] = lambda: None, exclusive: bool = False) -> None:
        """Upload a file under its final name only when it is whole; with `exclusive` an existing one stays where the store can tell."""
        path = self.path(name)
        if self._objects:
            self.patiently(lambda: self.system.put_file(str(source), path), check)
            return
        temporary = f"{self._root}/{UPLOADS}/{uuid.uuid4().hex}"
        self._make_folder(UPLOADS)
        self._make_folder(name.rpartition("/")[0])
        try:
            if self.local:
                self.patiently(lambda: shutil.copyfile(source, temporary), check)
                disk.sync(Path(temporary))
                if not exclusive or os.path.islink(path) or not _link(temporary, path):
                    disk.replace(Path(temporary), Path(path))
                disk.sync(Path(path).parent)
            else:
                self.patiently(lambda: self.system.put_file(str(source), temporary), check)
                if not exclusive or self.status(name, check) is None:
                    self.patiently(lambda: self.system.mv(temporary, path), check)
        finally:
            with suppress(Exception):  # usually it was renamed
                self.system.rm_file(temporary)

    def _make_folder(self, folder: str) -> None:
        """Make a folder of the store, level by level, so that no link is followed. Raises NotADirectoryError where one is in the way."""
        parts = folder.split("/") if folder else []
        for name in ("/".join(parts[:count]) for count in range(1, len(parts) + 1)):
            try:
                plain = self.is_plain(name)
            except FileNotFoundError:
                self.patiently(lambda name=name: self._make(f"{self._root}/{name}"))  # type: ignore[misc]
                plain = self.is_plain(name)
            if not plain:
                raise NotADirectoryError(f"'{name}' in it is a link or a file")

    def _make(self, path: str) -> None:
        try:
            if self.local:
                os.mkdir(path)
            else:
                self.system.ftp.mkdir(path)
        except OSError as error:
            try:  # another machine may have been faster
                _ = os.lstat(path) if self.local else self.system.ftp.lstat(path)
            except OSError:
                raise error from None

    def patiently(self, operation: Callable[[], _T], check: Callable[[], None] = lambda: None) -> _T:
        """Do something with the store; what fails is tried again, because networks come back. Raises StoreUnreachableError, or
        OSErrors that trying again does not change."""
        start, pause = time.monotonic(), 0.25
        while True:
            try:
                return operation()
            except (FileNotFoundError, PermissionError, GsbakeError):
                raise
            except Exception as error:
                if isinstance(error, OSError) and error.errno in DISK_FULL | NOT_WRITABLE | LASTING:
                    raise
                # Each library behind fsspec has its own exceptions.
                if time.monotonic() - start + pause > self._patience:
                    raise StoreUnreachableError(in_words(error, self._address)) from error
            check()
            time.sleep(pause)
            pause = min(2 * pause, 8.0)
            if hasattr(self.system, "reconnect"):
                with suppress(Exception):  # it does not answer yet; the operation fails again and says so
                    self.system.reconnect()


def _link(source: str, target: str) -> bool:
    """Give a file its name unless another has it; False on file systems without hard links."""
    try:
        disk.link(Path(source), Path(target))
    except FileExistsError:
        return True
    except OSError:
        return False
    return True


def _properties(info: Mapping[str, Any]) -> Properties | None:
    """Properties of an object, from what its file system gives; None for a prefix."""
    found: Iterable[Any] = (info.get(name) for name in ("mtime", "LastModified", "created"))
    value = next((v for v in found if v is not None), 0.0)
    time_ = value.timestamp() if isinstance(value, datetime) else float(value)
    return Properties(int(info["size"]), time_) if info.get("type") == "file" else None


def in_words(error: Exception, url: str) -> str:
    """One line that says what failed, without the credentials of the store's `url`, which libraries quote."""
    return " ".join(hide_credentials(f"{type(error).__name__}: {error}", url).split())[:200]
