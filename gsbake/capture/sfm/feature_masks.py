"""Masks in structure from motion: which features may be used, and which cameras the masks support.

Masks of the user and guesses of a network serve both: features are limited to them, dilated where they are guesses, and cameras are
judged by them (`gsbake.capture.sfm.mask_agreement`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsbake.capture.sfm.mask_agreement import MIN_AGREEMENT, MIN_GUESS_AGREEMENT, guess_agreement, mask_agreement
from gsbake.geometry.cameras import Camera
from gsbake.imaging.png import read_grey, write_png

#: Dilation of guessed masks before features are limited to them, as a share of the photo's longer side.
GUESS_MARGIN = 0.02


@dataclass(frozen=True)
class FeatureMasks:
    """Masks of the photo `entries` in the artifact folder `ingest`; `folder` is where they are written for COLMAP."""

    ingest: Path
    entries: Sequence[dict[str, Any]]
    folder: Path

    @property
    def files(self) -> dict[str, Path]:
        """Files by photo name, the user's mask before the network's guess."""
        return {e["name"]: self.ingest / (e["mask"] or e["guess"]) for e in self.entries if e["mask"] or e.get("guess")}

    @property
    def complete(self) -> bool:
        """Whether every photo has a mask or a guess."""
        return len(self.files) == len(self.entries)

    @property
    def guessed(self) -> bool:
        """Whether some are guesses."""
        return any(not e["mask"] and e.get("guess") for e in self.entries)

    @property
    def min_agreement(self) -> float:
        """Agreement below which cameras are not trusted."""
        return MIN_GUESS_AGREEMENT if self.guessed else MIN_AGREEMENT

    def agreement(self, cameras: Sequence[Camera]) -> float:
        """Agreement 0 … 1 of the cameras of registered photos with their masks."""
        if not cameras:
            return 0.0
        return (guess_agreement if self.guessed else mask_agreement)(cameras, self.files)

    def write(self, moving: Path | None = None, outside: bool = False) -> Path:
        """Write the masks under COLMAP's file names at the size of the photos, limited to those in the folder `moving`; their folder.

        With `outside` features are limited to what they do not show.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        files = self.files
        for entry in (e for e in self.entries if e["name"] in files):
            mask: Any = read_grey(files[entry["name"]])
            if not entry["mask"]:
                radius = max(1, round(GUESS_MARGIN * max(mask.shape)))
                disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
                mask = cv2.dilate(255 * (mask > 127).astype(np.uint8), np.asarray(disc, np.uint8))
                mask = cv2.resize(mask, (entry["width"], entry["height"]), interpolation=cv2.INTER_NEAREST)
            if outside:
                mask = 255 - mask
            if moving is not None:
                mask = np.minimum(mask, read_grey(moving / f"{entry['name']}.png.png"))
            write_png(self.folder / f"{entry['name']}.png.png", np.asarray(mask, np.uint8))
        return self.folder
