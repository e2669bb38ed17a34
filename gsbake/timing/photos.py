"""Number and size of a run's photos, which estimates scale with."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from gsbake.pipeline.plan import Request
from gsbake.pipeline.store import Store

#: Megapixels assumed where no header can be read.
USUAL_MEGAPIXELS = 12.0


@dataclass(frozen=True)
class PhotoSet:
    """Number of photos, and megapixels of one."""

    count: int
    megapixels: float


def photos_of_run(out: Path) -> PhotoSet | None:
    """Number and size of the photos that the newest ingest in an output folder read; None when there is none."""
    for folder, _ in Store(out).manifests("ingest"):
        with suppress(OSError, ValueError, KeyError, TypeError, IndexError):
            photos = json.loads((folder / "photos.json").read_text(encoding="utf-8"))["photos"]
            pixels = sorted(int(p["source_width"]) * int(p["source_height"]) for p in photos)
            return PhotoSet(len(pixels), pixels[len(pixels) // 2] / 1e6)
    return None


def photos_of_request(request: Request) -> PhotoSet:
    """Number of a capture's photos, and megapixels of the first one whose header can be read."""
    names = request.source_names.get("photos", ())
    for name in names[:3]:
        with suppress(Exception), Image.open(request.sources["photos"] / name) as image:  # only the header is read; a guess does too
            return PhotoSet(len(names), image.width * image.height / 1e6)
    return PhotoSet(len(names), USUAL_MEGAPIXELS)
