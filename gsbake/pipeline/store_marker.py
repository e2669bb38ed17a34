"""What makes a folder a shared store: the file `store.json` in it, which gsbake wrote.

Nothing is written or deleted in a folder without it, unless the folder is missing or empty and so becomes a store. Stores that gsbake
0.1.0 made have no such file: they are recognised by their whole layout, beside which nothing else may be there, and an artifact's manifest
whose seal is right.
"""

from __future__ import annotations

import json
from itertools import islice
from typing import Any, Literal

from gsbake.errors import UsageError
from gsbake.pipeline.store import parse_manifest
from gsbake.pipeline.store_files import BLOBS, ENTRIES, MARKER, UPLOADS, StoreFiles, is_store_name

#: Most bytes of an entry that is read: a manifest has a few hundred for each file of its stage.
MAX_ENTRY_BYTES = 64_000_000
#: What the marker says.
_KIND = "gsbake shared store"
_MAX_MARKER_BYTES = 65_536
#: Entries of an unmarked store that are read until one is intact.
_MOST_READ = 32
_FOLDERS = (ENTRIES, BLOBS, UPLOADS)


def marker(quota: int | None = None) -> bytes:
    """Content of the marker of a store that may hold `quota` bytes (None: without a limit)."""
    return json.dumps({"kind": _KIND, "quota_bytes": quota}).encode()


def is_marked(files: StoreFiles) -> bool:
    """Whether the marker is there."""
    return _read(files).get("kind") == _KIND


def read_quota(files: StoreFiles) -> int | None:
    """Most bytes that the store may hold; None without a limit."""
    found = _read(files).get("quota_bytes")
    return found if isinstance(found, int) and not isinstance(found, bool) else None


def recognise(files: StoreFiles, url: str) -> Literal["store", "old store", "new"]:
    """What a folder or prefix is: a store, one of an earlier version, or missing or empty. Raises UsageError for anything else."""
    kind = _kind(files, url)
    for name in _FOLDERS if kind != "new" else ():
        if _is_something_else(files, name):
            raise UsageError(f"'{name}' in the shared store '{url}' is a link or a file, not a folder; name another store with --store.")
    return kind


def _kind(files: StoreFiles, url: str) -> Literal["store", "old store", "new"]:
    if is_marked(files):
        return "store"
    try:
        top = files.top()
    except NotADirectoryError as error:
        raise UsageError(f"'{url}' is a file and cannot be a shared store; name a folder with --store.") from error
    if is_marked(files):  # made while the folder was listed
        return "store"
    if not top or (top == [MARKER] and _is_cut_off(files)):
        return "new"
    stranger = _stranger(files, top)
    if stranger is not None:
        raise UsageError(
            f"'{url}' is not empty and no shared store of gsbake ('{stranger}' is in it); name a new or an empty folder with --store."
        )
    return "old store"


def _read(files: StoreFiles) -> dict[str, Any]:
    """The marker's fields; none where it is missing or damaged."""
    status = files.status(MARKER)
    if status is None or status.size > _MAX_MARKER_BYTES:
        return {}
    try:
        found = json.loads(files.read(MARKER))
    except (FileNotFoundError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _is_something_else(files: StoreFiles, name: str) -> bool:
    try:
        return not files.is_plain(name)
    except (FileNotFoundError, NotADirectoryError):
        return False


def _is_cut_off(files: StoreFiles) -> bool:
    """Whether a process was killed, or another is at work, between the first and the last byte of a new marker."""
    status = files.status(MARKER)
    return status is not None and status.size < len(marker()) and marker().startswith(files.read(MARKER))


def _stranger(files: StoreFiles, top: list[str]) -> str | None:
    """Something in the folder that no earlier version of gsbake put there; None in a store of an earlier version."""
    stranger = next((name for name in top if name not in (*_FOLDERS, MARKER)), None)
    if stranger is not None or (MARKER in top and _read(files).keys() != {"quota_bytes"}):
        return stranger or MARKER
    for folder in _FOLDERS:
        for name, properties in files.walk(folder):
            if properties is None or not is_store_name(name):
                return name
    if any(_is_entry(files, name) for name in islice(files.find(ENTRIES), _MOST_READ)):
        return None
    return top[0]


def _is_entry(files: StoreFiles, name: str) -> bool:
    """Whether a file is the intact manifest of an artifact, and of the one that its name says."""
    stage, key = name.removesuffix(".json").split("/")[1:]
    status = files.status(name)
    if status is None or status.size > MAX_ENTRY_BYTES:
        return False
    manifest = parse_manifest(files.read(name))
    return manifest is not None and manifest.get("stage") == stage and manifest.get("key") == key
