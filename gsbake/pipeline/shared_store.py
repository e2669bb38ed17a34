"""Shared store: artifacts of many machines behind a folder or URL, beside the local store.

The layout is that of remote build caches (Bazel's action cache and content-addressable storage): `cas/<2 digits>/<BLAKE3>` holds the bytes
of a file, `ac/<stage>/<key>.json` the manifest of an artifact. The entry is written last, so what has one is complete. No locks: blobs are
named by their content, and of two machines that compute one key the first entry stays; the other takes its artifact. A blob is checked by
its digest when it is read; a wrong one is deleted together with the entry, and the stage is computed again.

Who can write to the store decides what others bake: digests protect from damage, not from people.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from gsbake.errors import GsbakeError, InterruptedRun, UsageError
from gsbake.pipeline.digest import file_digest
from gsbake.pipeline.files import DISK_FULL, NOT_WRITABLE
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.store import MANIFEST, Artifact, parse_manifest
from gsbake.pipeline.store_url import hide_credentials, public_url
from gsbake.system import disk

#: Seconds during which a store that does not answer is tried again.
PATIENCE = 120.0
#: Blobs without an entry are kept for this long, because a machine may be about to write the entry.
GRACE = 86_400.0
#: File in the store with its quota.
_SETTINGS = "store.json"
#: fsspec protocols whose writes are atomic: an object is there whole or not at all.
_OBJECT_STORES = frozenset({"s3", "s3a", "memory"})
_PROTOCOLS = frozenset({"file", "local", "sftp", "ssh"}) | _OBJECT_STORES
_T = TypeVar("_T")


class StoreUnreachableError(Exception):
    """The shared store did not answer in time; the message says what it answered last."""


@dataclass(frozen=True)
class StoreEntry:
    """An entry: stage, key, bytes of its files, digests of its blobs, and the time of its last use (its creation, in object stores)."""

    path: str
    stage: str
    key: str
    size: int
    blobs: tuple[str, ...]
    used: float


@dataclass
class StoreCheck:
    """What `verify` found: entries, blobs, and the names of damaged ones, which were deleted unless the store is read-only."""

    entries: int = 0
    blobs: int = 0
    damaged: list[str] = field(default_factory=list)


def open_shared_store(url: str | None, patience: float = PATIENCE) -> SharedStore | None:
    """The store of a folder or URL (file, s3, sftp); None without one. Raises UsageError for other kinds and missing packages."""
    if url is None:
        return None
    import fsspec

    protocol = url.partition("://")[0] if "://" in url else "file"
    if protocol not in _PROTOCOLS:
        raise UsageError(f"--store takes a folder or a URL of file, s3 or sftp, not '{public_url(url)}'.")
    try:
        if protocol in ("sftp", "ssh"):
            system, path = _open_sftp(url)
        else:
            options = {"skip_instance_cache": True, "use_listings_cache": False} if protocol in _OBJECT_STORES else {}
            system, path = fsspec.core.url_to_fs(url if "://" in url else str(Path(url).absolute()), **options)
    except ImportError as error:
        raise UsageError(f"--store {protocol}:// needs another package: pip install 'gsbake[store]'.") from error
    except GsbakeError:
        raise
    except Exception as error:  # a server that refuses, a wrong port: each library has its own exceptions
        raise InterruptedRun(
            f"The shared store '{public_url(url)}' cannot be opened ({_words(error, url)}); check the address and try again."
        ) from error
    return SharedStore(url, system, path.rstrip("/"), protocol, patience)


def _open_sftp(url: str) -> tuple[Any, str]:
    """The file system and the path of an sftp:// URL."""
    from gsbake.pipeline.sftp import SftpStore

    return SftpStore(**SftpStore._get_kwargs_from_urls(url), skip_instance_cache=True), str(SftpStore._strip_protocol(url))


class SharedStore:
    """A shared store; `read_only` once a write was refused, or when its owner set it. `url` has no credentials; it is for people."""

    def __init__(self, url: str, system: Any, path: str, protocol: str, patience: float = PATIENCE) -> None:
        self.url, self._address = public_url(url), url
        self.read_only = False
        self.damaged: list[str] = []
        self._fs, self._root, self._patience = system, path, patience
        self._local, self._objects = protocol in ("file", "local"), protocol in _OBJECT_STORES
        self._used: int | None = None

    def fetch(self, cache_key: CacheKey, folder: Path, check: Callable[[], None] = lambda: None) -> dict[str, Any] | None:
        """Download the artifact of a key into `folder`; its manifest, or None where there is none that is intact.

        `check` may raise to cancel. Raises StoreUnreachableError.
        """
        try:
            return self._fetch(cache_key, folder, check)
        except PermissionError as error:
            raise StoreUnreachableError("it may not be read") from error

    def _fetch(self, cache_key: CacheKey, folder: Path, check: Callable[[], None]) -> dict[str, Any] | None:
        entry = self._entry_path(cache_key.stage, cache_key.digest)
        manifest = self._read_entry(entry, cache_key.stage, cache_key.digest, check)
        if manifest is None or any(cache_key.settings.get(k, v) != v for k, v in manifest.get("settings", {}).items()):
            return None
        for name, file in manifest["files"].items():
            check()
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if not self._read_blob(str(file["digest"]), int(file["bytes"]), target, check):
                self._discard(entry)
                return None
        if self._local:
            with suppress(OSError):
                os.utime(entry)
        return manifest

    def put(self, artifact: Artifact, check: Callable[[], None] = lambda: None) -> str | None:
        """Upload an artifact, its entry last. Returns None, or why it was not stored ("read-only", "full").

        An entry that is there already stays. Raises StoreUnreachableError.
        """
        manifest = artifact.manifest
        entry = self._entry_path(str(manifest["stage"]), str(manifest["key"]))
        if self.read_only or self._exists(entry, None, check):
            return "read-only" if self.read_only else None
        files = {str(file["digest"]): (artifact.folder / name, int(file["bytes"])) for name, file in manifest["files"].items()}
        try:
            if not self._has_room(sum(size for _, size in files.values()), check):
                return "full"
            for digest, (path, size) in files.items():
                check()
                if not self._has_blob(digest, size, check):
                    self._write(path, self._blob_path(digest), check)
            self._write(artifact.folder / MANIFEST, entry, check, exclusive=True)
        except PermissionError:
            self.read_only = True
            return "read-only"
        except OSError as error:
            if error.errno in NOT_WRITABLE:
                self.read_only = True
                return "read-only"
            if error.errno in DISK_FULL:
                return "full"
            raise
        return None

    def digest_of(self, cache_key: CacheKey, check: Callable[[], None] = lambda: None) -> str | None:
        """Content digest of the artifact that the store has for a key; None when it has none. Raises StoreUnreachableError."""
        manifest = self._read_entry(self._entry_path(cache_key.stage, cache_key.digest), cache_key.stage, cache_key.digest, check)
        return None if manifest is None else str(manifest.get("digest"))

    # -- maintenance -----------------------------------------------------------------------------------------------------------------------

    def entries(self) -> list[StoreEntry]:
        """All intact entries, least recently used first; damaged ones are deleted."""
        found = []
        for path, info in self._find("ac").items():
            stage, key = path.rsplit("/", 2)[-2], path.rsplit("/", 1)[-1].removesuffix(".json")
            manifest = self._read_entry(path, stage, key)
            if manifest is not None:
                files = manifest["files"].values()
                blobs = tuple(sorted({str(f["digest"]) for f in files}))
                found.append(StoreEntry(path, stage, key, sum(int(f["bytes"]) for f in files), blobs, _modified(info)))
        return sorted(found, key=lambda e: e.used)

    def verify(self, scratch: Path) -> StoreCheck:
        """Read every entry and blob, and delete damaged ones; the next run computes their stages again. `scratch` is an empty folder."""
        found = StoreCheck()
        entries = self.entries()
        found.entries, found.damaged = len(entries), self.damaged
        bad = set()
        for path, info in self._find("cas").items():
            found.blobs += 1
            digest = path.rsplit("/", 1)[-1]
            if not self._read_blob(digest, int(info["size"]), scratch / "blob"):
                bad.add(digest)
        there = {path.rsplit("/", 1)[-1] for path in self._find("cas")} - bad
        for entry in entries:
            if not there.issuperset(entry.blobs):
                self._discard(entry.path)
        return found

    def collect_garbage(self, keep: int | None, *, dry_run: bool = False, grace: float = GRACE) -> tuple[int, int]:
        """Delete entries, least recently used first, until at most `keep` bytes are left, blobs that no entry names, and
        what killed uploads left.

        Returns the bytes freed and left.
        """
        if not dry_run:
            for path, info in self._find("tmp").items():  # of uploads that were killed
                if time.time() - _modified(info) >= grace:
                    self._delete(path)
        entries, blobs = self.entries(), self._find("cas")
        sizes = {path.rsplit("/", 1)[-1]: int(info["size"]) for path, info in blobs.items()}
        young = {path.rsplit("/", 1)[-1] for path, info in blobs.items() if time.time() - _modified(info) < grace}
        used: dict[str, int] = {}
        for digest in (digest for entry in entries for digest in entry.blobs):
            used[digest] = used.get(digest, 0) + 1
        total, released = sum(sizes.get(digest, 0) for digest in used), set()
        for entry in entries if keep is not None else ():
            if keep is None or total <= keep:
                break
            if not dry_run:
                self._delete(entry.path)
            for digest in entry.blobs:
                used[digest] -= 1
                if not used[digest]:
                    released.add(digest)
                    total -= sizes.get(digest, 0)
        doomed = [path for path in blobs if (name := path.rsplit("/", 1)[-1]) in released or (name not in used and name not in young)]
        freed = sum(int(blobs[path]["size"]) for path in doomed)
        if not dry_run:
            for path in doomed:
                self._delete(path)
        return freed, sum(sizes.values()) - freed

    def size(self) -> int:
        """Bytes of all blobs."""
        return sum(int(info["size"]) for info in self._find("cas").values())

    def quota(self) -> int | None:
        """Most bytes that the store may hold; None without a limit."""
        try:
            found = json.loads(self._patiently(lambda: self._fs.cat_file(f"{self._root}/{_SETTINGS}")))["quota_bytes"]
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None
        return int(found) if isinstance(found, int) else None

    def set_quota(self, size: int | None, scratch: Path) -> None:
        """Set or remove the limit for all machines. Raises PermissionError for a read-only store."""
        path = scratch / _SETTINGS
        path.write_bytes(json.dumps({"quota_bytes": size}).encode())
        self._write(path, f"{self._root}/{_SETTINGS}")

    # -- files -----------------------------------------------------------------------------------------------------------------------------

    def _entry_path(self, stage: str, key: str) -> str:
        return f"{self._root}/ac/{stage}/{key}.json"

    def _blob_path(self, digest: str) -> str:
        return f"{self._root}/cas/{digest[:2]}/{digest}"

    def _read_entry(self, path: str, stage: str, key: str, check: Callable[[], None] = lambda: None) -> dict[str, Any] | None:
        try:
            content = self._patiently(lambda: self._fs.cat_file(path), check)
        except FileNotFoundError:
            return None
        manifest = parse_manifest(content)
        if manifest is None or manifest.get("key") != key or manifest.get("stage") != stage or MANIFEST in manifest.get("files", {}):
            self._discard(path)
            return None
        return manifest

    def _read_blob(self, digest: str, size: int, target: Path, check: Callable[[], None] = lambda: None) -> bool:
        """Download a blob; False where it is missing or damaged, and then it is deleted."""
        path = self._blob_path(digest)
        try:
            self._patiently(lambda: self._fs.get_file(path, str(target)), check)
        except FileNotFoundError:
            return False
        if target.stat().st_size == size and file_digest(target) == digest:
            return True
        self._discard(path)
        return False

    def _has_blob(self, digest: str, size: int, check: Callable[[], None]) -> bool:
        """Whether a blob is there and intact; read, because an artifact may come again for other damage, and few blobs are there before."""
        with tempfile.TemporaryDirectory() as folder:
            return self._exists(self._blob_path(digest), size, check) and self._read_blob(digest, size, Path(folder) / "blob", check)

    def _discard(self, path: str) -> None:
        """Delete a damaged blob or entry. Where that is refused, the damage stays and is found again."""
        self.damaged.append(path.removeprefix(f"{self._root}/"))
        with suppress(PermissionError):
            self._delete(path)

    def _delete(self, path: str) -> None:
        with suppress(FileNotFoundError):
            self._patiently(lambda: self._fs.rm_file(path))

    def _exists(self, path: str, size: int | None, check: Callable[[], None]) -> bool:
        """Whether a file is there, with `size` bytes if given."""
        try:
            info = self._patiently(lambda: self._fs.info(path), check)
        except FileNotFoundError:
            return False
        return size is None or int(info["size"]) == size

    def _write(self, source: Path, path: str, check: Callable[[], None] = lambda: None, exclusive: bool = False) -> None:
        """Upload a file under its final name only when it is whole; with `exclusive` an existing one stays where the store can tell."""
        if self._objects:
            self._patiently(lambda: self._fs.put_file(str(source), path), check)
            return
        temporary = f"{self._root}/tmp/{uuid.uuid4().hex}"
        for parent in (f"{self._root}/tmp", path.rsplit("/", 1)[0]):
            self._patiently(partial(self._fs.makedirs, parent, exist_ok=True), check)
        try:
            if self._local:
                self._patiently(lambda: shutil.copyfile(source, temporary), check)
                disk.sync(Path(temporary))
                if not exclusive or not _link(temporary, path):
                    disk.replace(Path(temporary), Path(path))
                disk.sync(Path(path).parent)
            else:
                self._patiently(lambda: self._fs.put_file(str(source), temporary), check)
                if not exclusive or not self._exists(path, None, check):
                    self._patiently(lambda: self._fs.mv(temporary, path), check)
        finally:
            with suppress(Exception):  # usually it was renamed
                self._fs.rm_file(temporary)

    def _find(self, folder: str) -> dict[str, Mapping[str, Any]]:
        """{path: properties} of all files in a folder of the store."""
        try:
            found: dict[str, Mapping[str, Any]] = self._patiently(lambda: self._fs.find(f"{self._root}/{folder}", detail=True))
        except FileNotFoundError:
            return {}
        return found

    def _has_room(self, size: int, check: Callable[[], None]) -> bool:
        """Whether `size` more bytes are within the quota. The size of the store is asked once; other machines may go a little beyond."""
        quota = self.quota()
        if quota is None:
            return True
        if self._used is None:
            self._used = self.size()
        check()
        if self._used + size > quota:
            return False
        self._used += size
        return True

    def _patiently(self, operation: Callable[[], _T], check: Callable[[], None] = lambda: None) -> _T:
        """Do something with the store; what fails is tried again, because networks come back. Raises StoreUnreachableError, or
        FileNotFoundError and PermissionError, which trying again does not change."""
        start, pause = time.monotonic(), 0.25
        while True:
            try:
                return operation()
            except (FileNotFoundError, PermissionError, GsbakeError):
                raise
            except Exception as error:
                if isinstance(error, OSError) and error.errno in DISK_FULL | NOT_WRITABLE:
                    raise
                # Each library behind fsspec has its own exceptions.
                if time.monotonic() - start + pause > self._patience:
                    raise StoreUnreachableError(_words(error, self._address)) from error
            check()
            time.sleep(pause)
            pause = min(2 * pause, 8.0)
            if hasattr(self._fs, "reconnect"):
                with suppress(Exception):  # it does not answer yet; the operation fails again and says so
                    self._fs.reconnect()


def _link(source: str, target: str) -> bool:
    """Give a file its name unless another has it; False on file systems without hard links."""
    try:
        disk.link(Path(source), Path(target))
    except FileExistsError:
        return True
    except OSError:
        return False
    return True


def _modified(info: Mapping[str, Any]) -> float:
    """Time of last modification in seconds since the epoch, from the properties that a file system gives."""
    found: Iterable[Any] = (info.get(name) for name in ("mtime", "LastModified", "created"))
    value = next((v for v in found if v is not None), 0.0)
    return value.timestamp() if isinstance(value, datetime) else float(value)


def _words(error: Exception, url: str) -> str:
    """One line that says what failed, without the credentials of the store's `url`, which libraries quote."""
    return " ".join(hide_credentials(f"{type(error).__name__}: {error}", url).split())[:200]
