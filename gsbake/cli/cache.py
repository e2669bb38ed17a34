"""`gsbake cache ls`, `verify` and `gc` of an output folder: list and check stored artifacts and delete unused ones."""

from __future__ import annotations

import re
import time

from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_table, print_text
from gsbake.errors import BadInputError, UsageError
from gsbake.own_files import SET_ASIDE
from gsbake.pipeline.store import Store
from gsbake.text import shortlist, size

_SIZE_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_AGE_UNITS = {"h": 3600.0, "d": 86_400.0, "w": 604_800.0}


def parse_size(text: str) -> int:
    """Bytes of "20GB", "500 MB" or "0". Raises UsageError."""
    found = re.fullmatch(r"\s*(\d{1,12}(?:\.\d{1,6})?)\s*([kmgt]?b)?\s*", text, re.IGNORECASE)
    if not found:
        raise UsageError(f"--keep takes a size such as 20GB or 500MB, not '{text}'.")
    return int(float(found.group(1)) * _SIZE_UNITS[(found.group(2) or "").upper()])


def parse_age(text: str) -> float:
    """Seconds of "30d", "12h" or "2w". Raises UsageError."""
    found = re.fullmatch(r"\s*(\d{1,6}(?:\.\d{1,6})?)\s*([hdw])\s*", text)
    if not found:
        raise UsageError(f"--older takes an age such as 12h, 30d or 2w, not '{text}'.")
    return float(found.group(1)) * _AGE_UNITS[found.group(2)]


def list_outputs(options: Options) -> None:
    """Print everything that the garbage collection may delete."""
    from gsbake.pipeline.garbage import list_entries

    store, stages = _open(options)
    entries = sorted(list_entries(store, stages), key=lambda e: e.used)
    if options.as_json:
        rows = [{"path": str(e.path), "stage": e.stage, "kind": e.kind, "bytes": e.size, "used": e.used} for e in entries]
        print_json({"out": str(store.out), "entries": rows, "bytes": sum(e.size for e in entries)}, indent=None)
        return
    print_table(
        ("stage", "kind", "name", "size", "last used"),
        [(e.stage, e.kind, e.path.name, size(e.size), time.strftime("%Y-%m-%d %H:%M", time.localtime(e.used))) for e in entries],
    )


def verify(options: Options) -> None:
    """Compare every file of every artifact with its digest. Raises BadInputError when one is damaged; the next run computes it again."""
    store, stages = _open(options)
    checked = [(stage, folder, faults) for stage in stages for folder, faults in store.verify(stage)]
    damaged = [(stage, folder, faults) for stage, folder, faults in checked if faults]
    if damaged:
        store.digests.forget()  # the next run must see what this command saw
        store.digests.save()
    if options.as_json:
        rows = [{"stage": stage, "folder": str(folder), "faults": faults} for stage, folder, faults in checked]
        print_json({"out": str(store.out), "artifacts": rows, "damaged": len(damaged)}, indent=None)
    elif not options.quiet:
        print_text(f"{len(checked)} stored outputs in '{store.out}' checked, {len(damaged)} damaged.")
    if damaged:
        stage, _, faults = damaged[0]
        raise BadInputError(f"Stage '{stage}': {faults[0]}. The next run computes it again; files of your own must be replaced again.")


def collect_garbage(options: Options, keep: str | None, older: str | None) -> None:
    """Delete artifacts of old keys, checkpoints and files of killed runs."""
    from gsbake.pipeline.garbage import choose, delete, list_entries

    limits = (None if keep is None else parse_size(keep), None if older is None else parse_age(older))
    store, stages = _open(options)
    entries = list_entries(store, stages)
    chosen = choose(entries, *limits)
    done = chosen if options.dry_run else delete(store, chosen)
    moved = store.take_moved()
    if moved and not options.quiet:
        names = shortlist([path.name for path in moved])
        print_text(f"{names}: not what a stage wrote; moved to '{store.out / SET_ASIDE}'.", error=True)
    freed, left = sum(e.size for e in done), sum(e.size for e in entries) - sum(e.size for e in done)
    if options.as_json:
        rows = [{"path": str(e.path), "kind": e.kind, "bytes": e.size} for e in done]
        print_json({"out": str(store.out), "deleted": rows, "freed_bytes": freed, "left_bytes": left}, indent=None)
    elif not options.quiet:
        verb = "would be deleted" if options.dry_run else "deleted"
        print_text(f"{len(done)} of {len(entries)} entries {verb}: {size(freed)} freed, {size(left)} left in '{store.out}'.")


def _open(options: Options) -> tuple[Store, tuple[str, ...]]:
    """The artifacts of an output folder, and the names of the stages; links are named on stderr, because nothing behind them is looked at.

    Raises UsageError for a folder that is not gsbake's.
    """
    from gsbake.api import open_store
    from gsbake.pipeline.garbage import require_run

    store, stages = open_store(options.out)
    require_run(store.out)
    for link in sorted({link for stage in stages if (link := store.behind_link(stage)) is not None}):
        print_text(f"'{link}' is a link; what is behind it is left alone.", error=True)
    return store, stages
