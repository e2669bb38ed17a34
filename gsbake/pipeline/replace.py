"""Replacement of a stage's output by the user's files, stored as an artifact that later stages read until it is undone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

from gsbake.atomic import write_atomic
from gsbake.errors import UsageError
from gsbake.pipeline.digest import list_files, tree_digest
from gsbake.pipeline.events import now
from gsbake.pipeline.files import remove_tree
from gsbake.pipeline.lease import Lease
from gsbake.pipeline.store import MANIFEST, REPLACEMENT, REPLACEMENT_PREFIX, Artifact, Store, read_manifest
from gsbake.system.names import unusable_name


def replace_output(
    store: Store, stage: str, files: Mapping[str, Path], base: Artifact | None, origin: Mapping[str, Path] | None = None
) -> Artifact:
    """Replace a stage's output by `files` ({name in the artifact: the user's file, or what was made of the one in `origin`}).

    Files of `base` (the current output) that are not replaced are kept. The user's files are copied, so they may be edited or deleted
    afterwards. Those of an earlier replacement are set aside, for they may be the only copy; `store.take_moved` says where. Raises
    UsageError for names that cannot be files on every system.
    """
    bad = unusable_name([*files, MANIFEST])
    if bad is not None:
        raise UsageError(f"{bad} cannot be the name of a file in a stage's output on every system; rename it.")
    own = {**files, **(origin or {})}
    with _lease(store, stage):
        store.remove_leftovers(stage, REPLACEMENT_PREFIX)
        temporary = store.temporary(stage, REPLACEMENT_PREFIX)
        try:
            kept = {name: base.folder / name for name in base.files if name not in files} if base is not None else {}
            for name, path in {**kept, **files}.items():
                target = temporary / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
            digest = tree_digest(store.digests.files(temporary, list_files(temporary)))
            final = store.stage_folder(stage) / f"{REPLACEMENT_PREFIX}-{digest[:8]}"
            manifest = {
                "stage": stage,
                "replaced": {name: str(path) for name, path in own.items()},
                "kept": sorted(kept),
                "finished": now(),
                "seconds": 0.0,
                "peak_bytes": 0,
                "parts": {},
                "results": {},
                "decisions": [{"what": "output", "choice": "replaced by the user", "evidence": ", ".join(str(p) for p in own.values())}],
                "warnings": [],
            }
            artifact = store.publish(temporary, final, manifest)
        finally:
            if temporary.exists():
                remove_tree(temporary)
        write_atomic(store.stage_folder(stage) / REPLACEMENT, json.dumps({"folder": final.name}), durable=True)
        _set_other_replacements_aside(store, stage, final.name)
    store.digests.save()
    return artifact


def undo_replacement(store: Store, stage: str) -> None:
    """Restore the stage's own output; the user's files are set aside. Raises UsageError when it was not replaced."""
    record = store.stage_folder(stage) / REPLACEMENT
    if store.replacement(stage) is None:
        raise UsageError(f"The output of stage '{stage}' in '{store.out}' was not replaced; there is nothing to undo.")
    with _lease(store, stage):
        _set_other_replacements_aside(store, stage, "")  # before the record: interrupted between the two, the loss is reported
        record.unlink(missing_ok=True)


def folder_files(folder: Path) -> dict[str, Path]:
    """{relative name: path} of a folder that replaces the whole output."""
    return {name: folder / name for name in list_files(folder) if name != MANIFEST}


def _lease(store: Store, stage: str) -> Lease:
    lease = Lease(store.stage_folder(stage) / f"{REPLACEMENT_PREFIX}.lease")
    lease.acquire()
    return lease


def _set_other_replacements_aside(store: Store, stage: str, keep: str) -> None:
    for entry in store.stage_folder(stage).glob(f"{REPLACEMENT_PREFIX}-*"):
        if entry.is_dir() and entry.name != keep:
            manifest = read_manifest(entry) or {}
            store.set_aside_changed(entry, given=manifest.get("replaced", ()))
            remove_tree(entry)
