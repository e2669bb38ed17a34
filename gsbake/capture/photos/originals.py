"""The photos of a capture at full size, as the ingest stage kept them, before undistortion.

A photo that is no larger than the working size has no original: its working photo is read. So is one whose working photo was replaced by
hand, which the original does not show. Originals come from outside: they are decoded in a process of their own (`reader_process`).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.conversion import FULL_SIZE, file_digest
from gsbake.capture.photos.decode import Bytes, working_size
from gsbake.capture.photos.reader_pool import MAX_READERS, MIN_SECONDS, SECONDS_PER_BYTE, ReaderProcesses
from gsbake.imaging.png import read_grey
from gsbake.limited_process import read_in_child
from gsbake.memory_budget import MemoryBudget

#: Largest photo in millions of pixels: ingestion has let it pass.
_MEGAPIXELS = 10_000.0
#: Difference (of 255) of a mask at full size, reduced, from the working mask from which the working mask counts.
_OTHER_MASK = 128
#: Bytes per pixel that reading a photo may take: more are waited for, and its time limit is computed from them.
_BYTES = 64


class Originals:
    """Photos by name, from the artifact folder of the ingest stage, or none; `close` it at the end.

    Threads may read at the same time: `readers` do, the others wait.
    """

    def __init__(self, ingest: Path | None, readers: int = 1) -> None:
        self._folder = ingest or Path()
        entries: list[dict[str, Any]] = []
        if ingest is not None:
            entries = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
        self._entries = {entry["name"]: entry for entry in entries}
        self._processes, self._budget = ReaderProcesses(max(1, min(readers, MAX_READERS))), MemoryBudget()

    def close(self) -> None:
        """End the processes that decode; a later call starts them again."""
        self._processes.close()

    def entries(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """What the ingest stage wrote of photos; nothing where it did not of all of them."""
        found = [self._entries[name] for name in names if name in self._entries]
        return found if len(found) == len(names) else []

    def has(self, name: str) -> bool:
        """Whether there is more of a photo than its working photo."""
        entry = self._entries.get(name, {})
        return bool(entry.get("original")) and file_digest(self._folder / entry["file"]) == entry["digest"]

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of a photo that has an original."""
        entry = self._entries[name]
        return working_size(entry["source_width"], entry["source_height"], FULL_SIZE)

    def read(self, name: str, max_size: int = FULL_SIZE) -> Bytes:
        """The photo (h, w, 3), upright, 8-bit sRGB, the longer side at most `max_size` pixels: area filter in linear light.

        For one that has an original. Raises BadInputError when it cannot be read, OSError when the disk is full, InterruptedRun when its
        process is killed.
        """
        entry = self._entries[name]
        pixels = entry["source_width"] * entry["source_height"]
        with tempfile.TemporaryDirectory(prefix="gsbake-photo-") as folder:
            out = Path(folder) / "pixels.npy"
            request = {"task": "read", "path": str(self._folder / entry["original"]), "name": entry["source"], "out": str(out)}
            request |= {"max_size": max_size, "max_megapixels": _MEGAPIXELS}
            seconds = MIN_SECONDS + SECONDS_PER_BYTE * _BYTES * pixels
            with self._processes.idle() as process, self._budget.reserve(_BYTES * pixels):
                answer = read_in_child(process, request, seconds, f"The original of {entry['source']}")
            if "os_error" in answer:
                raise OSError(*answer["os_error"])
            return np.asarray(np.load(out), np.uint8)

    def mask(self, name: str, size: tuple[int, int]) -> Bytes | None:
        """The mask (h, w) that was given with a photo, at most of its full size, reduced to `size` (width, height) by an area filter; None
        where there is none of more than the working size."""
        entry = self._entries[name]
        if entry["full_mask"] is None:
            return None
        mask = read_grey(self._folder / entry["full_mask"])
        return mask if mask.shape[::-1] == size else np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.uint8)


def changed_pixels(full: Bytes, working: Bytes) -> NDArray[np.bool_]:
    """Where (h, w) the `working` mask was changed: it says the other of the mask at full size that it was reduced from."""
    reduced = cv2.resize(full, working.shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.absdiff(reduced, working) >= _OTHER_MASK)
