"""Shared store: artifacts of many machines behind a folder or URL, beside the local store.

The layout is that of remote build caches (Bazel's action cache and content-addressable storage): `cas/<2 digits>/<BLAKE3>` holds the bytes
of a file, `ac/<stage>/<key>.json` the manifest of an artifact. The entry is written last, so what has one is complete. No locks: blobs are
named by their content, and of two machines that compute one key the first entry stays; the other takes its artifact. A blob is checked by
its digest when it is read; a wrong one is deleted together with the entry, and the stage is computed again.

Who can write to the store decides what others bake: digests protect from damage, not from people. But no entry decides where something is
written or deleted: digests and names are checked before they become paths.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError, InterruptedRun, UsageError
from gsbake.pipeline import store_files
from gsbake.pipeline.digest import file_digest
from gsbake.pipeline.files import DISK_FULL, NOT_WRITABLE
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.store import MANIFEST, Artifact, parse_manifest
from gsbake.pipeline.store_files import BLOBS, ENTRIES, MARKER, Properties, StoreFiles, StoreUnreachableError, in_words
from gsbake.pipeline.store_marker import MAX_ENTRY_BYTES, is_marked, marker, read_quota, recognise
from gsbake.pipeline.store_url import public_url

#: Seconds during which a store that does not answer is tried again, and where nothing depends on it.
PATIENCE, SHORT_PATIENCE = 120.0, 10.0
#: Blobs without an entry are kept for this long, because a machine may be about to write the entry.
GRACE = 86_400.0
_PROTOCOLS = frozenset({"file", "local", "sftp", "ssh"}) | store_files.OBJECT_STORES


@dataclass(frozen=True)
class StoreEntry:
    """An entry: its name in the store, stage, key, bytes of its files, {digest: bytes} of its blobs, and the time of its last use (its
    creation, in object stores)."""

    name: str
    stage: str
    key: str
    size: int
    blobs: dict[str, int]
    used: float


@dataclass
class StoreCheck:
    """What `verify` found: entries, blobs, and the names of damaged ones."""

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
            options = {"skip_instance_cache": True, "use_listings_cache": False} if protocol in store_files.OBJECT_STORES else {}
            system, path = fsspec.core.url_to_fs(url if "://" in url else str(Path(url).absolute()), **options)
    except ImportError as error:
        raise UsageError(f"--store {protocol}:// needs another package: pip install 'gsbake[store]'.") from error
    except GsbakeError:
        raise
    except Exception as error:  # a server that refuses, a wrong port: each library has its own exceptions
        raise InterruptedRun(
            f"The shared store '{public_url(url)}' cannot be opened ({in_words(error, url)}); check the address and try again."
        ) from error
    return SharedStore(url, system, path.rstrip("/"), protocol, patience)


def _open_sftp(url: str) -> tuple[Any, str]:
    """The file system and the path of an sftp:// URL."""
    from gsbake.pipeline.sftp import SftpStore

    return SftpStore(**SftpStore._get_kwargs_from_urls(url), skip_instance_cache=True), str(SftpStore._strip_protocol(url))


def refuse_other_folders(url: str | None) -> None:
    """Raise UsageError where `url` cannot be a shared store, because something else is there. One that does not answer may be one."""
    with suppress(StoreUnreachableError, InterruptedRun):
        store = open_shared_store(url, SHORT_PATIENCE)
        if store is not None:
            store.require()


class SharedStore:
    """A shared store; `url` is its address without credentials; `read_only` once a write was refused, or when its owner set it.

    `notices` are sentences for the user, `damaged` the names of what was damaged; who prints them takes them out.
    """

    def __init__(self, url: str, system: Any, path: str, protocol: str, patience: float = PATIENCE) -> None:
        self.url, self._address = public_url(url), url
        self.read_only = False
        self.damaged: list[str] = []
        self.notices: list[str] = []
        self.files = StoreFiles(system, path, protocol, patience, url)
        self._kind = "new"
        self._used: int | None = None

    def require(self) -> None:
        """Raise UsageError where something else than a shared store is there, or StoreUnreachableError."""
        with _in_words(self._address):
            self._look()

    def fetch(self, cache_key: CacheKey, folder: Path, check: Callable[[], None] = lambda: None) -> dict[str, Any] | None:
        """Download the artifact of a key into the empty `folder`; its manifest, or None where there is none that is intact.

        `check` may raise to cancel. Raises StoreUnreachableError.
        """
        with _in_words(self._address):
            return self._fetch(cache_key, folder, check) if self._look() != "new" else None

    def _fetch(self, cache_key: CacheKey, folder: Path, check: Callable[[], None]) -> dict[str, Any] | None:
        entry, known = _entry_name(cache_key.stage, cache_key.digest), len(self.damaged)
        manifest = self._read_entry(entry, check)
        if manifest is None:
            self._discard(self.damaged[known:])
            return None
        if any(cache_key.settings.get(k, v) != v for k, v in manifest.get("settings", {}).items()):
            return None
        if sum(file["bytes"] for file in manifest["files"].values()) > shutil.disk_usage(folder).free:
            self.notices.append(f"{entry} names more bytes than are free here; it is not used.")
            return None
        for name, file in manifest["files"].items():
            check()
            try:
                target = _new_file(folder, name)
            except (OSError, ValueError) as error:
                if isinstance(error, OSError) and error.errno in DISK_FULL | NOT_WRITABLE:
                    raise
                words = in_words(error, self._address)
                self.notices.append(f"{entry} names a file that this system cannot have ({words}); it is not used.")
                return None
            if not self._read_blob(file["digest"], file["bytes"], target, check):
                self.damaged.append(entry)
                self._discard(self.damaged[known:])
                return None
        self.files.mark_used(entry)
        return manifest

    def put(self, artifact: Artifact, check: Callable[[], None] = lambda: None) -> str | None:
        """Upload an artifact, its entry last. Returns None, or why it was not stored ("read-only", "full").

        An entry that is there already stays. Raises StoreUnreachableError.
        """
        if self.read_only:
            return "read-only"
        manifest = artifact.manifest
        entry = _entry_name(str(manifest["stage"]), str(manifest["key"]))
        files = {str(file["digest"]): (artifact.folder / name, int(file["bytes"])) for name, file in manifest["files"].items()}
        with _in_words(self._address):
            if self._look() != "new" and self.files.status(entry, check) is not None:
                return None
            try:
                self._become_store()
                if not self._has_room(sum(size for _, size in files.values()), check):
                    return "full"
                for digest, (path, size) in files.items():
                    check()
                    if not self._has_blob(digest, size, check):
                        self.files.write(path, _blob_name(digest), check)
                self.files.write(artifact.folder / MANIFEST, entry, check, exclusive=True)
            except OSError as error:
                if isinstance(error, PermissionError) or error.errno in NOT_WRITABLE:
                    self.read_only = True
                    return "read-only"
                if error.errno in DISK_FULL:
                    return "full"
                raise
        return None

    def digest_of(self, cache_key: CacheKey, check: Callable[[], None] = lambda: None) -> str | None:
        """Content digest of the artifact that the store has for a key; None when it has none. Raises StoreUnreachableError."""
        with _in_words(self._address):
            manifest = self._read_entry(_entry_name(cache_key.stage, cache_key.digest), check) if self._look() != "new" else None
        return None if manifest is None else str(manifest.get("digest"))

    # -- maintenance -----------------------------------------------------------------------------------------------------------------------

    def entries(self) -> list[StoreEntry]:
        """All intact entries, least recently used first; the names of others are added to `damaged`. Raises UsageError for a folder that is
        no store."""
        found = []
        for name, status in self._find(ENTRIES).items():
            manifest = self._read_entry(name)
            if manifest is not None:
                blobs = {file["digest"]: file["bytes"] for file in manifest["files"].values()}
                size = sum(file["bytes"] for file in manifest["files"].values())
                found.append(StoreEntry(name, manifest["stage"], manifest["key"], size, blobs, status.modified))
        return sorted(found, key=lambda e: e.used)

    def verify(self, scratch: Path) -> StoreCheck:
        """Read every entry and blob; nothing is written or deleted. The run that needs a damaged one replaces it. `scratch` is an empty
        folder."""
        self.damaged = []
        found = StoreCheck()
        entries = self.entries()
        found.entries = len(entries)
        expected = {digest: size for entry in entries for digest, size in entry.blobs.items()}
        intact = set()
        for name, status in self._find(BLOBS).items():
            found.blobs += 1
            digest = name.rsplit("/", 1)[-1]
            if self._read_blob(digest, expected.get(digest, status.size), scratch / "blob"):
                intact.add(digest)
        self.damaged += [entry.name for entry in entries if not intact.issuperset(entry.blobs)]
        found.damaged = self.damaged
        return found

    def collect_garbage(self, keep: int | None, *, dry_run: bool = False, grace: float = GRACE) -> tuple[int, int]:
        """Delete entries, least recently used first, until at most `keep` bytes are left, damaged entries, blobs that no entry names, and
        what killed uploads left.

        Returns the bytes freed and left. Raises UsageError for a folder that is no store.
        """
        if self._look() == "new":
            return 0, 0
        self.damaged = []
        entries, blobs = self.entries(), self._find(BLOBS)
        now = time.time()
        sizes = {name.rsplit("/", 1)[-1]: status.size for name, status in blobs.items()}
        young = {name.rsplit("/", 1)[-1] for name, status in blobs.items() if now - status.modified < grace}
        doomed = [*self.damaged, *(name for name, status in self._find(store_files.UPLOADS).items() if now - status.modified >= grace)]
        used: dict[str, int] = {}
        for digest in (digest for entry in entries for digest in entry.blobs):
            used[digest] = used.get(digest, 0) + 1
        total, released = sum(sizes.get(digest, 0) for digest in used), set()
        for entry in entries if keep is not None else ():
            if keep is None or total <= keep:
                break
            doomed.append(entry.name)
            for digest in entry.blobs:
                used[digest] -= 1
                if not used[digest]:
                    released.add(digest)
                    total -= sizes.get(digest, 0)
        kept = (used.keys() | young) - released
        unnamed = [name for name in blobs if name.rsplit("/", 1)[-1] not in kept]
        freed = sum(blobs[name].size for name in unnamed)
        if not dry_run:
            self._become_store()
            for name in [*doomed, *unnamed]:  # entries before what they name
                self.files.delete(name)
        return freed, sum(sizes.values()) - freed

    def size(self) -> int:
        """Bytes of all blobs."""
        return sum(status.size for status in self._find(BLOBS).values())

    def quota(self) -> int | None:
        """Most bytes that the store may hold; None without a limit."""
        return read_quota(self.files)

    def set_quota(self, size: int | None, scratch: Path) -> None:
        """Set or remove the limit for all machines. Raises PermissionError for a read-only store, UsageError for a folder that is none."""
        self._become_store()
        self._write_marker(size, scratch)

    # -- files -----------------------------------------------------------------------------------------------------------------------------

    def _look(self) -> str:
        """What is there: "store", "old store", or "new" until somebody makes one. Raises UsageError for anything else."""
        if self._kind == "new":
            self._kind = recognise(self.files, self.url)
        return self._kind

    def _become_store(self) -> None:
        """Make a store of what is new, and mark one of an earlier version, before anything is written or deleted."""
        if self._look() == "store":
            return
        if self._kind == "new":
            self.files.create(MARKER, marker())
        if not is_marked(self.files):  # of an earlier version, or a new one whose marker was cut off
            with tempfile.TemporaryDirectory() as scratch:
                self._write_marker(self.quota(), Path(scratch))
            if self._kind == "old store":
                self.notices.append(f"it was made by an earlier version of gsbake and is now marked as a store ({MARKER}).")
        self._kind = "store"

    def _write_marker(self, quota: int | None, scratch: Path) -> None:
        path = scratch / MARKER
        path.write_bytes(marker(quota))
        self.files.write(path, MARKER)

    def _read_entry(self, name: str, check: Callable[[], None] = lambda: None) -> dict[str, Any] | None:
        """The manifest in an entry; None where there is none, or where it is damaged, which is noted."""
        stage, key = name.removesuffix(".json").split("/")[1:]
        status = self.files.status(name, check)
        if status is None:
            return None
        try:
            manifest = parse_manifest(self.files.read(name, check)) if status.size <= MAX_ENTRY_BYTES else None
        except FileNotFoundError:  # deleted meanwhile
            return None
        if manifest is None or manifest.get("key") != key or manifest.get("stage") != stage:
            self.damaged.append(name)
            return None
        return manifest

    def _read_blob(self, digest: str, size: int, target: Path, check: Callable[[], None] = lambda: None) -> bool:
        """Download a blob; False where it is missing, or damaged, which is noted."""
        name = _blob_name(digest)
        status = self.files.status(name, check)
        if status is None:
            return False
        if status.size == size:  # only then: a larger one could fill the disk
            try:
                self.files.download(name, target, check)
            except FileNotFoundError:
                return False
            if target.stat().st_size == size and file_digest(target) == digest:
                return True
        self.damaged.append(name)
        return False

    def _has_blob(self, digest: str, size: int, check: Callable[[], None]) -> bool:
        """Whether a blob is there and intact; read, because an artifact may come again for other damage, and few blobs are there before."""
        if self.files.status(_blob_name(digest), check) is None:
            return False
        with tempfile.TemporaryDirectory() as folder:
            return self._read_blob(digest, size, Path(folder) / "blob", check)

    def _discard(self, names: list[str]) -> None:
        """Delete what was damaged. Where that is refused, the damage stays and is found again."""
        try:
            for name in names:
                self._become_store()
                self.files.delete(name)
        except OSError as error:
            if not isinstance(error, PermissionError) and error.errno not in NOT_WRITABLE | DISK_FULL:
                raise

    def _find(self, folder: str) -> dict[str, Properties]:
        """{name: properties} of the files in a folder of the store. Raises UsageError where there is no store."""
        return self.files.find(folder) if self._look() != "new" else {}

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


def _entry_name(stage: str, key: str) -> str:
    return f"{ENTRIES}/{stage}/{key}.json"


def _blob_name(digest: str) -> str:
    return f"{BLOBS}/{digest[:2]}/{digest}"


def _new_file(folder: Path, name: str) -> Path:
    """An empty file in a folder, for what is downloaded. Raises OSError or ValueError for a name that cannot be, or is taken."""
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.open("xb").close()
    return target


@contextmanager
def _in_words(url: str) -> Iterator[None]:
    """Turn what cannot be helped by trying again into StoreUnreachableError; a full disk of this machine stays an OSError."""
    try:
        yield
    except PermissionError as error:
        raise StoreUnreachableError("it may not be read") from error
    except (OSError, ValueError) as error:  # ValueError: a stage whose name a store cannot have
        if isinstance(error, OSError) and error.errno in DISK_FULL:
            raise
        raise StoreUnreachableError(in_words(error, url)) from error
