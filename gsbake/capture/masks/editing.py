"""The masks that a run uses, as files that the user can edit and give back."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.originals import changed_pixels
from gsbake.errors import BadInputError
from gsbake.imaging.png import read_grey, write_png
from gsbake.own_files import require_own_folder


def export_masks(ingest: Path, poses: Path | None, folder: Path, only: frozenset[str] | None = None) -> list[Path]:
    """Write the masks in use into `folder`, one per photo, of its size and under its name; returns the files.

    `ingest` and `poses` are artifact folders; without `poses` there are no automatic masks. `only` names the photos whose masks are
    written; None writes all. Raises BadInputError when there are no masks, UsageError when the folder is neither new nor empty.
    """
    entries: list[dict[str, Any]] = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
    files = {}
    for entry in entries:
        made = None if poses is None else poses / "photo_masks" / f"{entry['name']}.png"
        if made is not None and made.exists():
            files[entry["name"]] = made
        elif entry["mask"]:
            files[entry["name"]] = ingest / entry["mask"]
    chosen = [entry for entry in entries if entry["name"] in files and (only is None or entry["name"] in only)]
    if files and not chosen:
        raise BadInputError("None of this run's masks is doubtful; without --doubtful all of them are written.")
    if not chosen:
        raise BadInputError("This run has no masks; give some with --masks, or install the mask network (`gsbake doctor` says how).")
    require_own_folder(folder, False, "a mask")
    targets = [(folder / entry["source"]).with_suffix(".png") for entry in chosen]
    for target in targets:
        if Path(os.path.abspath(folder)) not in Path(os.path.abspath(target)).parents:
            raise BadInputError(f"The mask '{target}' would lie outside '{folder}'; run `gsbake ingest` again.")
    for entry, target in zip(chosen, targets, strict=True):
        mask: Any = cv2.imread(str(files[entry["name"]]), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise FileNotFoundError(files[entry["name"]])
        target.parent.mkdir(parents=True, exist_ok=True)
        write_png(target, _at_full_size(ingest, entry, mask))
    return targets


def _at_full_size(ingest: Path, entry: dict[str, Any], mask: Any) -> NDArray[np.uint8]:
    """The `mask` of a working photo at the size of its source: the one that was given, unless this one differs from it."""
    if entry.get("full_mask"):
        given = read_grey(ingest / entry["full_mask"])
        if given.shape == (entry["source_height"], entry["source_width"]) and not changed_pixels(given, mask).any():
            return given
    return np.asarray(cv2.resize(mask, (entry["source_width"], entry["source_height"]), interpolation=cv2.INTER_LINEAR), np.uint8)
