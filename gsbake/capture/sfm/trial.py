"""Trial of features on a few small photos: whole ones, inside the masks, outside of them. It decides what is tried first at full size.

Structure from motion of hundreds of photos takes minutes, and where object and room move against each other it takes longest. Two dozen
small photos show the contradiction in seconds: under wrong cameras the masks have no common hull, or cameras of different photos coincide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from gsbake.imaging.png import write_png

#: Where features are detected.
Region = Literal["whole photos", "moving parts", "masks", "outside the masks"]
#: Regions of a trial, in this order.
TRIED: tuple[Region, ...] = ("whole photos", "masks", "outside the masks")
#: Photos of a trial, their longer side in pixels, and their features. They follow each other by name, so that they overlap.
PHOTOS, SIZE, FEATURES = 24, 600, 2048
#: Captures of fewer photos are solved without a trial: they take no longer.
MIN_CAPTURE = 36
#: Share of the photos of a trial that a usable solution registers.
MIN_REGISTERED = 0.5


@dataclass(frozen=True)
class Trial:
    """The solution of a trial: `registered` of so many `photos`, mean `reprojection` error in pixels, and agreement with the masks."""

    region: Region
    registered: int
    photos: int
    agreement: float
    reprojection: float

    def usable(self, min_agreement: float, share: float = MIN_REGISTERED) -> bool:
        """Whether a `share` of the photos is registered and the masks agree."""
        return self.registered >= share * self.photos and self.agreement >= min_agreement

    @property
    def text(self) -> str:
        """What was found, for the log."""
        error = f", {self.reprojection:.2f} px" if self.registered else ""
        return f"{self.region}: {self.registered} registered{error}, masks agree to {self.agreement:.2f}"


def best_region(trials: Sequence[Trial], min_agreement: float) -> Region:
    """The region that registers most photos among those that the masks support, then the one of least error.

    Without any, the first that the masks do not contradict: too few photos registered to say. Whole photos where they contradict all.
    """
    usable = [trial for trial in trials if trial.usable(min_agreement)]
    if usable:
        return max(usable, key=lambda trial: (trial.registered, -trial.reprojection)).region
    return next((trial.region for trial in trials if trial.registered < MIN_REGISTERED * trial.photos), "whole photos")


def write_small_photos(ingest: Path, entries: Sequence[dict[str, Any]], folder: Path) -> list[dict[str, Any]]:
    """Write the photos of a trial of the photo `entries` in `ingest` into `folder`; their entries, whose masks are guesses."""
    folder.mkdir(parents=True, exist_ok=True)
    small = []
    for entry in sorted(entries, key=lambda e: str(e["name"]))[:PHOTOS]:
        image: Any = cv2.imread(str(ingest / entry["file"]), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(ingest / entry["file"])
        scale = min(1.0, SIZE / max(image.shape[:2]))
        width, height = (max(1, round(scale * edge)) for edge in (image.shape[1], image.shape[0]))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        write_png(folder / f"{entry['name']}.png", np.ascontiguousarray(image[..., ::-1], np.uint8))
        focal = None if entry["focal_px"] is None else entry["focal_px"] * scale
        guess = entry["mask"] or entry.get("guess")
        small.append({**entry, "width": width, "height": height, "focal_px": focal, "mask": None, "guess": guess})
    return small
