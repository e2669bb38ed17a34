"""Compare the automatic masks of a run, and the silhouettes of its mesh, with masks made by hand.

python -m benchmarks.masks OUT MASKS

OUT is the output folder of `gsbake poses` or `gsbake run`, MASKS the folder of the true masks (a.png or a.jpg.png for a.jpg).
Prints the intersection over union of the network's guesses, of the masks in use after the agreement between photos, and of the silhouettes
of the mesh where there is one: median, 10 % quantile and worst, and the photos below 0.9. Masks are compared at the size of the ingested
photos, silhouettes at half of it and without distortion.
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
from gsbake.capture.photos.undistortion import remap_tables, resample
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.ply import read_mesh
from gsbake.geometry.raycast import RayCaster
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


def silhouettes(poses: Path, mesh: Path, ingest: Path, truth: Path) -> dict[str, float]:
    """Intersection over union by photo of the silhouettes of `mesh` in the cameras of `poses` with the true masks."""
    entries = {e["name"]: e for e in json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]}
    files = match_masks(truth, {entry["source"]: ingest / entry["file"] for entry in entries.values()})
    photo_cameras = {camera.name: camera for camera in CameraSet.load(poses / "photo_cameras.json").cameras}
    caster, found = RayCaster(*read_mesh(mesh / "mesh.ply")), {}
    for camera in CameraSet.load(poses / "cameras.json").cameras:
        source = photo_cameras[camera.name]
        mask = np.uint8(255) * _binary(files[entries[camera.name]["source"]], (source.width, source.height))
        small = camera.downscaled_to(max(camera.width, camera.height) // 2)
        whole = resample(mask, remap_tables(source, camera), mask=True)
        expected = cv2.resize(whole, (small.width, small.height), interpolation=cv2.INTER_AREA)
        shown = caster.first_hit(small.centre[None], small.rays().reshape(-1, 3)).hit.reshape(small.height, small.width)
        found[camera.name] = intersection_over_union(shown, expected > 127)
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
    found = compare(ingest, poses, options.masks)
    if meshes := store.manifests("mesh"):
        found["mesh"] = silhouettes(poses, meshes[0][0], ingest, options.masks)
    for kind, overlaps in found.items():
        print(line(kind, overlaps))


if __name__ == "__main__":
    main()
