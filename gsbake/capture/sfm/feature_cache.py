"""Features of photos, and matches and geometry of pairs, that outlive a run: adding ten photos to a capture costs those of ten photos.

Entries are found by content. The key of a photo's features is a digest of the photo, its mask and the settings of the detection; that of
matches is the keys of both photos, that of their geometry also a digest of what it depends on. So an entry is what a new computation would
give, and results do not depend on it. An entry that is missing, damaged or cannot be written costs time only.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from gsbake.atomic import atomic_replacement

Keypoints = NDArray[np.float32]
Descriptors = NDArray[np.uint8]
Matches = NDArray[np.uint32]

#: What reading a file that is missing or damaged raises.
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
#: Changes when the content of the files does.
_VERSION = 1


def photo_key(photo: Path, mask: Path | None, detection: Mapping[str, Any]) -> str:
    """Key of the features of a photo file inside a mask file, detected with the settings `detection` (JSON values)."""
    digest = blake3(json.dumps([_VERSION, dict(detection)], sort_keys=True).encode())
    for path in (photo, mask):
        digest.update(b"-" if path is None else blake3(path.read_bytes()).digest())
    return digest.hexdigest(16)


class FeatureCache:
    """The entries in a folder; None keeps nothing."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def features(self, key: str) -> tuple[Keypoints, Descriptors] | None:
        """Keypoints (n, 6) and descriptors (n, 128) of a photo, or None."""
        found = self._load("features", key)
        keypoints, descriptors = found.get("keypoints"), found.get("descriptors")
        if keypoints is None or descriptors is None or len(keypoints) != len(descriptors):
            return None
        if keypoints.dtype != np.float32 or descriptors.dtype != np.uint8 or descriptors.shape[1:] != (128,):
            return None
        return keypoints, descriptors

    def keep_features(self, key: str, keypoints: Keypoints, descriptors: Descriptors) -> None:
        """Keep the features of a photo."""
        self._save("features", key, keypoints=keypoints, descriptors=descriptors)

    def matches(self, keys: tuple[str, str]) -> Matches | None:
        """Matches (m, 2) of a pair of photos, or None."""
        found = self._load("matches", "-".join(keys)).get("matches")
        return found if found is not None and found.dtype == np.uint32 and found.shape[1:] == (2,) else None

    def keep_matches(self, keys: tuple[str, str], matches: Matches) -> None:
        """Keep the matches of a pair."""
        self._save("matches", "-".join(keys), matches=matches)

    def geometry(self, name: tuple[str, str, str]) -> dict[str, NDArray[Any]] | None:
        """Arrays of the two-view geometry of a pair, named by the keys of both photos and a digest, or None."""
        found = self._load("geometry", "-".join(name))
        return found if {"config", "matches", "angle"} <= found.keys() else None

    def keep_geometry(self, name: tuple[str, str, str], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep the two-view geometry of a pair."""
        self._save("geometry", "-".join(name), **arrays)

    def _load(self, kind: str, name: str) -> dict[str, NDArray[Any]]:
        if self._folder is None:
            return {}
        try:
            with np.load(self._folder / kind / f"{name}.npz", allow_pickle=False) as body:
                return {array: body[array] for array in body.files}
        except _UNREADABLE:
            return {}

    def _save(self, kind: str, name: str, **arrays: NDArray[Any]) -> None:
        if self._folder is None:
            return
        with suppress(OSError):
            folder = self._folder / kind
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_replacement(folder / f"{name}.npz") as temporary, temporary.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
