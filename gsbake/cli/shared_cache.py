"""`gsbake cache ls`, `verify`, `gc` and `quota` of a shared store."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from gsbake.cli.cache import parse_size
from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_table, print_text
from gsbake.errors import BadInputError, InterruptedRun, UsageError
from gsbake.pipeline.shared_store import SharedStore, StoreUnreachableError, open_shared_store
from gsbake.text import size

#: Seconds during which these commands wait for a store that does not answer.
_PATIENCE = 10.0


def list_outputs(options: Options) -> None:
    """Print the entries of the store."""
    store = _open(options)
    try:
        entries, total, quota = store.entries(), store.size(), store.quota()
    except StoreUnreachableError as error:
        raise _unreachable(store, error) from error
    if options.as_json:
        rows = [{"stage": e.stage, "key": e.key, "bytes": e.size, "used": e.used} for e in entries]
        print_json({"store": store.url, "entries": rows, "bytes": total, "quota_bytes": quota}, indent=None)
        return
    print_table(
        ("stage", "key", "size", "last used"),
        [(e.stage, e.key[:16], size(e.size), time.strftime("%Y-%m-%d %H:%M", time.localtime(e.used))) for e in entries],
    )
    print_text(f"{len(entries)} outputs, {size(total)} in '{store.url}'" + (f", quota {size(quota)}." if quota is not None else "."))


def verify(options: Options) -> None:
    """Read every entry and blob. Raises BadInputError when one is damaged; the next run computes its stage again."""
    store = _open(options)
    try:
        with tempfile.TemporaryDirectory() as scratch:
            found = store.verify(Path(scratch))
    except StoreUnreachableError as error:
        raise _unreachable(store, error) from error
    if options.as_json:
        print_json({"store": store.url, "entries": found.entries, "blobs": found.blobs, "damaged": found.damaged}, indent=None)
    elif not options.quiet:
        print_text(f"{found.entries} outputs and {found.blobs} files in '{store.url}' checked, {len(found.damaged)} damaged.")
    if found.damaged:
        raise BadInputError(f"{found.damaged[0]} in '{store.url}' was damaged and deleted; the next run computes its stage again.")


def collect_garbage(options: Options, keep: str | None, older: str | None) -> None:
    """Delete the least recently used entries, and files that no entry names."""
    if older is not None:
        raise UsageError("--older is for output folders; a shared store takes --keep.")
    limit = None if keep is None else parse_size(keep)
    store = _open(options)
    try:
        freed, left = store.collect_garbage(limit, dry_run=options.dry_run)
    except StoreUnreachableError as error:
        raise _unreachable(store, error) from error
    except PermissionError as error:
        raise BadInputError(f"'{store.url}' may not be written; use an account that may.") from error
    if options.as_json:
        print_json({"store": store.url, "freed_bytes": freed, "left_bytes": left}, indent=None)
    elif not options.quiet:
        print_text(f"{size(freed)} {'would be freed' if options.dry_run else 'freed'}, {size(left)} left in '{store.url}'.")


def set_quota(options: Options, text: str) -> None:
    """Set the quota of the store; "none" removes it."""
    limit = None if text == "none" else parse_size(text)
    store = _open(options)
    try:
        with tempfile.TemporaryDirectory() as scratch:
            store.set_quota(limit, Path(scratch))
    except StoreUnreachableError as error:
        raise _unreachable(store, error) from error
    except PermissionError as error:
        raise BadInputError(f"'{store.url}' may not be written; use an account that may.") from error
    if options.as_json:
        print_json({"store": store.url, "quota_bytes": limit}, indent=None)
    elif not options.quiet:
        print_text(f"'{store.url}': {'no quota' if limit is None else f'quota {size(limit)}'}.")


def _open(options: Options) -> SharedStore:
    store = open_shared_store(options.store, _PATIENCE)
    if store is None:
        raise UsageError("Name the shared store with --store DIR|URL.")
    return store


def _unreachable(store: SharedStore, error: StoreUnreachableError) -> InterruptedRun:
    return InterruptedRun(f"The shared store '{store.url}' does not answer ({error}); check the address and the network, and try again.")
