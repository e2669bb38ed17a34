"""What a batch keeps on disk, in ROOT/.batch/: its captures and options, and one record per job that ended.

A record with an exit code other than 0 and 75 is final for the inputs and settings that it names: the job is not run again until they
change or the user asks for it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from gsbake.atomic import write_atomic
from gsbake.batch.captures import BatchOptions, CapturePlan
from gsbake.errors import BadInputError, InterruptedRun, UsageError
from gsbake.own_files import entries, require_own_folder

FOLDER = ".batch"
#: What a batch makes in that folder; the first is its mark.
_MADE = frozenset({"batch.json", "records", "lock", "snakemake", "snakemake.log", "snakemake.json"})


def require_own_records(root: Path) -> None:
    """Raise UsageError where ROOT/.batch is somebody else's."""
    folder = root / FOLDER
    found = set(entries(folder))
    own = found == {"lock"} or ("batch.json" in found and found <= _MADE)
    require_own_folder(folder, own and not folder.is_symlink(), "the record of the batch")


@dataclass(frozen=True)
class Record:
    """End of a job: exit code and sentence (of a job that is done: on files of the user's in the places of results), seconds, host, `key`,
    the cache key of the first stage that it had to run, and the nodes of a farm on which it was interrupted."""

    capture: str
    job: str
    exit_code: int
    message: str
    seconds: float
    host: str
    finished: str
    key: str
    failed_on: tuple[str, ...] = ()

    @property
    def final(self) -> bool:
        """Whether trying again will not help."""
        return self.exit_code not in (0, InterruptedRun.exit_code)

    def write(self, root: Path) -> None:
        """Write the record."""
        folder = root / FOLDER / "records"
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / f"{self.job}.json", json.dumps(asdict(self), indent=1))


def read_record(root: Path, job: str) -> Record | None:
    """The record of a job; None when it has none or it cannot be read."""
    with suppress(OSError, ValueError, TypeError):
        return TypeAdapter(Record).validate_json((root / FOLDER / "records" / f"{job}.json").read_bytes())
    return None


def all_records(root: Path) -> list[Record]:
    """All records, oldest first."""
    names = (path.stem for path in (root / FOLDER / "records").glob("*.json"))
    return sorted((r for name in names if (r := read_record(root, name)) is not None), key=lambda r: r.finished)


class RecordReader:
    """Reads the records that are new since the last look, without reading the others again."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folder_time = -1
        self._times: dict[str, int] = {}

    def new_records(self) -> list[Record]:
        """New and changed records, oldest first."""
        found: list[Record] = []
        with suppress(FileNotFoundError):
            time = os.stat(self._root / FOLDER / "records").st_mtime_ns
            if time == self._folder_time:
                return []
            with os.scandir(self._root / FOLDER / "records") as entries:
                for entry in entries:
                    changed = entry.stat().st_mtime_ns
                    if entry.name.endswith(".json") and self._times.get(entry.name) != changed:
                        self._times[entry.name] = changed
                        record = read_record(self._root, entry.name.removesuffix(".json"))
                        found += [record] if record is not None else []
            self._folder_time = time
        return sorted(found, key=lambda r: r.finished)


def pending_key(plan: CapturePlan) -> str:
    """Cache key of the first stage of a capture that has to run; empty when none has."""
    return next((state.cache_key.digest for state in plan.to_run if state.cache_key is not None), "")


def earlier_failures(root: Path, plans: Sequence[CapturePlan]) -> dict[str, Record]:
    """{capture: record} of the captures whose last job failed for good at the stage that is still their first to run."""
    records = {record.capture: record for record in all_records(root)}
    keys = {plan.name: pending_key(plan) for plan in plans}
    return {name: r for name, r in records.items() if r.final and r.key and r.key == keys.get(name)}


def forget_records(root: Path, keep: Sequence[Record]) -> None:
    """Delete all records but those to `keep`."""
    kept = {record.job for record in keep}
    for path in (root / FOLDER / "records").glob("*.json"):
        if path.stem not in kept:
            path.unlink(missing_ok=True)


def save_batch(captures: Sequence[Path], options: BatchOptions) -> None:
    """Write the captures and options, for `gsbake batch status`."""
    folder = options.root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    body = {**asdict(options), "root": None, "store": options.named_store, "captures": [str(path.absolute()) for path in captures]}
    write_atomic(folder / "batch.json", json.dumps(body, indent=1))


@dataclass(frozen=True)
class _Stored:
    captures: list[str]
    profile: str
    overrides: tuple[str, ...]
    threads: int
    seed: int
    store: str | None
    root: None = None
    moved: bool = False


def load_batch(root: Path) -> tuple[list[Path], BatchOptions]:
    """The captures and options of the batch in `root`. Raises UsageError when there is none, BadInputError when it is damaged."""
    path = root / FOLDER / "batch.json"
    try:
        body = TypeAdapter(_Stored).validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise UsageError(f"'{root}' holds no batch; name its folder with --out.") from error
    except (OSError, ValidationError) as error:
        raise BadInputError(f"'{path}' cannot be read; run the batch again, which writes it anew.") from error
    return [Path(name) for name in body.captures], BatchOptions(
        root, body.profile, body.overrides, body.threads, body.seed, body.store, body.moved
    )
