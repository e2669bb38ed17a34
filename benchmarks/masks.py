"""Compare the automatic masks of a run with masks made by hand.

python -m benchmarks.masks OUT MASKS

OUT is the output folder of `gsbake poses` on photos without masks, MASKS the folder of the true masks (a.png or a.jpg.png for a.jpg).
Prints the intersection over union of the network's guesses, and of the masks in use after the agreement between photos: median, 10 %
quantile and worst, and the photos below 0.9. Masks are compared at the size of the ingested photos.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.masks.consensus import intersection_over_union
from gsbake.capture.masks.matching import match_masks
from gsbake.pipeline.store import Store


def compare(ingest: Path, poses: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Intersection over union by photo, of the "guesses" and of the masks "in use"; `ingest` and `poses` are artifact folders."""
    entries = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
    files = match_masks(truth, {entry["source"]: ingest / entry["file"] for entry in entries})
    found: dict[str, dict[str, float]] = {"guesses": {}, "in use": {}}
    for entry in entries:
        size = entry["width"], entry["height"]
        expected = _binary(files[entry["source"]], size)
        for kind, path in (("guesses", ingest / str(entry["guess"])), ("in use", poses / "photo_masks" / f"{entry['name']}.png")):
            if path.is_file():
                found[kind][entry["name"]] = intersection_over_union(_binary(path, size), expected)
    return found


def _binary(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    mask: Any = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR) > 127)


def line(kind: str, overlaps: dict[str, float]) -> str:
    """One line of figures."""
    values = list(overlaps.values())
    if not values:
        return f"{kind}: none"
    low = sorted((name for name in overlaps if overlaps[name] < 0.9), key=lambda name: overlaps[name])
    named = ", ".join(f"{name} {overlaps[name]:.3f}" for name in low) or "none"
    return (
        f"{kind}: {len(values)} masks, median {np.median(values):.3f}, 10 % {np.quantile(values, 0.1):.3f}, worst {min(values):.3f}; "
        f"below .9: {named}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("masks", type=Path)
    options = parser.parse_args(arguments)
    store = Store(options.out)
    ingest, poses = (store.manifests(stage)[0][0] for stage in ("ingest", "poses"))
    for kind, overlaps in compare(ingest, poses, options.masks).items():
        print(line(kind, overlaps))


if __name__ == "__main__":
    main()
