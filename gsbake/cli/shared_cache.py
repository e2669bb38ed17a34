"""`gsbake cache ls`, `verify`, `gc` and `quota` of a shared store."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsbake.cli.cache import parse_size
from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_table, print_text
from gsbake.errors import BadInputError, InterruptedRun, UsageError
from gsbake.pipeline.shared_store import SHORT_PATIENCE, SharedStore, open_shared_store
from gsbake.pipeline.store_files import StoreUnreachableError
from gsbake.text import size


def list_outputs(options: Options) -> None:
    """Print the entries of the store."""
    with _opened(options) as store:
        entries, total, quota = store.entries(), store.size(), store.quota()
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
    """Read every entry and blob; nothing is written. Raises BadInputError when one is damaged."""
    with _opened(options) as store, tempfile.TemporaryDirectory() as scratch:
        found = store.verify(Path(scratch))
    if options.as_json:
        print_json({"store": store.url, "entries": found.entries, "blobs": found.blobs, "damaged": found.damaged}, indent=None)
    elif not options.quiet:
        print_text(f"{found.entries} outputs and {found.blobs} files in '{store.url}' checked, {len(found.damaged)} damaged.")
    if found.damaged:
        raise BadInputError(f"{found.damaged[0]} in '{store.url}' is damaged; the next run that needs it computes its stage again.")


def collect_garbage(options: Options, keep: str | None, older: str | None) -> None:
    """Delete the least recently used entries, and files that no entry names."""
    if older is not None:
        raise UsageError("--older is for output folders; a shared store takes --keep.")
    limit = None if keep is None else parse_size(keep)
    with _opened(options) as store:
        freed, left = store.collect_garbage(limit, dry_run=options.dry_run)
    if options.as_json:
        print_json({"store": store.url, "freed_bytes": freed, "left_bytes": left}, indent=None)
    elif not options.quiet:
        print_text(f"{size(freed)} {'would be freed' if options.dry_run else 'freed'}, {size(left)} left in '{store.url}'.")


def set_quota(options: Options, text: str) -> None:
    """Set the quota of the store; "none" removes it."""
    limit = None if text == "none" else parse_size(text)
    with _opened(options) as store, tempfile.TemporaryDirectory() as scratch:
        store.set_quota(limit, Path(scratch))
    if options.as_json:
        print_json({"store": store.url, "quota_bytes": limit}, indent=None)
    elif not options.quiet:
        print_text(f"'{store.url}': {'no quota' if limit is None else f'quota {size(limit)}'}.")


@contextmanager
def _opened(options: Options) -> Iterator[SharedStore]:
    """The store, with its errors in words, and its notices on stderr afterwards. Raises UsageError for a folder that is none."""
    store = open_shared_store(options.store, SHORT_PATIENCE)
    if store is None:
        raise UsageError("Name the shared store with --store DIR|URL.")
    try:
        yield store
    except StoreUnreachableError as error:
        raise InterruptedRun(
            f"The shared store '{store.url}' does not answer ({error}); check the address and the network, and try again."
        ) from error
    except PermissionError as error:
        raise BadInputError(f"'{store.url}' may not be read or written; use an account that may.") from error
    for text in store.notices:
        print_text(f"Shared store '{store.url}': {text}", error=True)
