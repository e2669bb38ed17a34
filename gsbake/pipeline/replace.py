"""A person's own file in place of a stage's output: registered as an artifact, used by every later stage until it is undone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

from gsbake.errors import UsageError
from gsbake.pipeline.digest import list_files, tree_digest
from gsbake.pipeline.events import now
from gsbake.pipeline.files import remove_tree, write_atomic
from gsbake.pipeline.lease import Lease
from gsbake.pipeline.store import MANIFEST, REPLACED, Artifact, Store

_LABEL = "by-hand"


def replace_output(store: Store, stage: str, files: Mapping[str, Path], base: Artifact | None) -> Artifact:
    """Put `files` ({name in the artifact: the person's file}) in place of the stage's output.

    Files of `base` (the output so far) that are not replaced are kept. The given files are copied, so they may be
    edited or deleted afterwards.
    """
    with _lease(store, stage):
        store.sweep(stage, _LABEL)
        temporary = store.temporary(stage, _LABEL)
        try:
            kept = {name: base.folder / name for name in base.files if name not in files} if base is not None else {}
            for name, path in {**kept, **files}.items():
                target = temporary / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
            digest = tree_digest(store.digests.files(temporary, list_files(temporary)))
            final = store.stage_folder(stage) / f"{_LABEL}-{digest[:8]}"
            manifest = {
                "stage": stage,
                "replaced": {name: str(path) for name, path in files.items()},
                "kept": sorted(kept),
                "finished": now(),
                "seconds": 0.0,
                "peak_bytes": 0,
                "parts": {},
                "results": {},
                "decisions": [{"what": "output", "choice": "replaced by hand", "evidence": ", ".join(str(p) for p in files.values())}],
                "warnings": [],
            }
            artifact = store.publish(temporary, final, manifest)
        finally:
            if temporary.exists():
                remove_tree(temporary)
        write_atomic(store.stage_folder(stage) / REPLACED, json.dumps({"folder": final.name}), durable=True)
        _forget_others(store, stage, final.name)
    store.digests.save()
    return artifact


def undo_replacement(store: Store, stage: str) -> None:
    """Go back to the stage's own output; UsageError when nothing was replaced."""
    note = store.stage_folder(stage) / REPLACED
    if not note.exists():
        raise UsageError(f"The output of stage '{stage}' in '{store.out}' was not replaced, so there is nothing to undo.")
    with _lease(store, stage):
        note.unlink(missing_ok=True)
        _forget_others(store, stage, "")


def folder_files(folder: Path) -> dict[str, Path]:
    """{relative name: path} of a folder that replaces a whole output."""
    return {name: folder / name for name in list_files(folder) if name != MANIFEST}


def _lease(store: Store, stage: str) -> Lease:
    lease = Lease(store.stage_folder(stage) / f"{_LABEL}.lease")
    lease.acquire()
    return lease


def _forget_others(store: Store, stage: str, keep: str) -> None:
    for entry in store.stage_folder(stage).glob(f"{_LABEL}-*"):
        if entry.is_dir() and entry.name != keep:
            remove_tree(entry)
