"""Reading a capture: the user's photos, masks and poses become upright 8-bit working photos, measured, with poses at their size."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from blake3 import blake3

from gsbake.capture.masks.matching import mask_of, match_masks
from gsbake.capture.photos.decode import RawPhoto, UnreadablePhotoError, read_photo, to_working
from gsbake.capture.photos.exif import camera_key, focal_pixels
from gsbake.capture.photos.quality import Quality, blurred, measure, near_duplicates
from gsbake.capture.photos.sharpness import finer_than_sharp
from gsbake.capture.poses.frames import Given, PhotoSize
from gsbake.capture.poses.given import read_poses
from gsbake.capture.sources import list_photos
from gsbake.config.schema import Ingest
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.ply import write_cloud
from gsbake.imaging.png import write_png
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip
from gsbake.text import shortlist


@dataclass(frozen=True)
class IngestOptions:
    """Settings of reading; `resolution` is the rule of [skip]."""

    ingest: Ingest = Ingest()
    resolution: Rule = "auto"


@dataclass(frozen=True)
class _Photo:
    """What is kept of a photo once its working files are written."""

    entry: dict[str, Any]
    size: PhotoSize
    quality: Quality


@dataclass(frozen=True)
class _MaskSource:
    """Where a photo's mask comes from: its mask file, or its alpha channel when there is none."""

    file: Path | None
    invert: bool


def ingest(
    photos: Path,
    out: Path,
    options: IngestOptions | None = None,
    *,
    masks: Path | None = None,
    poses: Path | None = None,
    threads: int = 2,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Read, check and reduce all photos of the folder `photos`; write the working files into the folder `out` and return the figures.

    Written: `photos/<name>.png` and `masks/<name>.png` (8-bit), `photos.json` (what is known of each, and what was skipped), and with known
    `poses` (a file or folder that `read_poses` takes) `poses/cameras.json` and `poses/points.ply`. Raises BadInputError when too few photos
    are usable, or masks that the options require are missing.
    """
    run = _Ingestion(photos, out, options or IngestOptions(), masks, poses, threads, monitor)
    return run.run()


@dataclass
class _Ingestion:
    """One run; `read` maps the path of each usable photo, relative to the folder, to what is kept of it."""

    folder: Path
    out: Path
    options: IngestOptions
    mask_folder: Path | None
    poses: Path | None
    threads: int
    monitor: Monitor
    skipped: list[dict[str, str]] = field(default_factory=list)
    read: dict[str, _Photo] = field(default_factory=dict)

    def run(self) -> dict[str, Any]:
        """The recipe."""
        settings = self.options.ingest
        paths = {path.relative_to(self.folder).as_posix(): path for path in list_photos(self.folder)}
        names = photo_names(paths)
        use_masks = settings.masks != "ignore"
        masks = match_masks(self.mask_folder, paths) if use_masks and self.mask_folder is not None else {}
        with self.monitor.part("duplicates"):
            self._drop_copies(paths)
        with self.monitor.part("photos"):
            self._read_all(paths, names, masks)
        if len(self.read) < settings.min_photos:
            first = self.skipped[0] if self.skipped else None
            lost = f" ({len(self.skipped)} of {len(names)} were skipped: {first['source']}: {first['why']})" if first else ""
            raise BadInputError(
                f"{self.folder} has {len(self.read)} usable photos{lost}, but at least {settings.min_photos} are needed; "
                "take more around the object."
            )
        self._report_quality()
        self._report_masks(masks)
        with self.monitor.part("resolution"):
            self._reduce_resolution()
        results = {"poses": "none"} if self.poses is None else self._read_poses(self.poses, list(names))
        entries = self._entries
        (self.out / "photos.json").write_text(json.dumps({"photos": entries, "skipped": self.skipped}, indent=1))
        blur = sorted(e["blur"] for e in entries)
        return {
            "photos": len(entries),
            "skipped": len(self.skipped),
            "masks": sum(e["mask"] is not None for e in entries),
            "near_duplicates": sum(e["duplicate_of"] is not None for e in entries),
            "blur_median": blur[len(blur) // 2],
            "megapixels": sum(e["width"] * e["height"] for e in entries) / 1e6,
            **results,
        }

    @property
    def _entries(self) -> list[dict[str, Any]]:
        return [photo.entry for photo in self.read.values()]

    def _drop_copies(self, paths: dict[str, Path]) -> None:
        """Remove photos whose file is byte for byte that of an earlier one from `paths`."""
        known: dict[tuple[int, str], str] = {}
        for relative, path in list(paths.items()):
            try:
                key = (path.stat().st_size, blake3(path.read_bytes()).hexdigest())
            except OSError as error:
                self.skipped.append({"source": relative, "why": f"cannot be read ({error.strerror})"})
                self.monitor.warn(f"The photo {relative} cannot be read ({error.strerror}) and was skipped.")
                del paths[relative]
                continue
            if key in known:
                self.skipped.append({"source": relative, "why": f"same file as {known[key]}"})
                self.monitor.warn(f"The photo {relative} is a copy of {known[key]} and was skipped.")
                del paths[relative]
            else:
                known[key] = relative

    def _read_all(self, paths: dict[str, Path], names: dict[str, str], masks: dict[str, Path]) -> None:
        """Decode, reduce, measure and write all photos, a few at once; unreadable ones are skipped with a warning."""
        for sub in ("photos", "masks"):
            (self.out / sub).mkdir(exist_ok=True)
        cv2.setNumThreads(1)  # the pool below is the parallelism
        settings = self.options.ingest
        with ThreadPoolExecutor(max(1, min(self.threads, 8))) as pool:

            def submit(relative: str) -> Future[_Photo]:
                source = _MaskSource(masks.get(relative), settings.invert_masks) if settings.masks != "ignore" else None
                return pool.submit(_read_one, paths[relative], relative, names[relative], source, self.out, settings.max_size)

            try:
                for done, (relative, future) in enumerate(_in_order(submit, list(paths), 2 * max(1, self.threads))):
                    self.monitor.progress(done, len(paths), relative)
                    try:
                        self.read[relative] = future.result()
                    except UnreadablePhotoError as error:
                        self.skipped.append({"source": relative, "why": str(error)})
                        self.monitor.warn(f"The photo {relative} is unreadable or truncated and was skipped ({error}).")
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        self.monitor.progress(len(paths), len(paths))
        if not any(entry["mask"] for entry in self._entries):
            (self.out / "masks").rmdir()

    def _report_quality(self) -> None:
        """Mark near-duplicates, and warn of them and of blurred photos."""
        entries = self._entries
        alike = near_duplicates([photo.quality.thumbnail for photo in self.read.values()])
        for entry, earlier in zip(entries, alike, strict=True):
            if earlier is not None:
                entry["duplicate_of"] = entries[earlier]["name"]
        pairs = [f"{e['name']} = {e['duplicate_of']}" for e in entries if e["duplicate_of"]]
        if pairs:
            self.monitor.warn(f"{len(pairs)} photos show the same as another one ({shortlist(pairs)}); they are kept but add nothing.")
        soft = blurred([e["blur"] for e in entries])
        if soft:
            names = shortlist([entries[i]["name"] for i in soft])
            self.monitor.warn(f"{len(soft)} photos are much more blurred than the rest ({names}).")

    def _report_masks(self, masks: dict[str, Path]) -> None:
        """Say how many photos have masks and where these come from. Raises BadInputError where masks are required but missing."""
        setting, total = self.options.ingest.masks, len(self.read)
        without = [entry["name"] for entry in self._entries if entry["mask"] is None]
        count = total - len(without)
        if without and setting == "require":
            raise BadInputError(
                f"{len(without)} of {total} photos have no mask ({shortlist(without)}), but ingest.masks is require; "
                "give them masks or set it to auto."
            )
        files = sum(relative in masks for relative in self.read)
        given = f"{count} of {total} photos have one: {files} mask files, {count - files} alpha channels" if count else "no photo has one"
        self.monitor.decide("masks", "used" if count else "none", "set by the profile" if setting == "ignore" else given)
        if count and without:
            self.monitor.warn(f"{len(without)} of {total} photos have no mask ({shortlist(without)}); give every photo one.")

    def _reduce_resolution(self) -> None:
        """Halve the working photos and masks where the photos hold no finer detail."""
        entries = self._entries
        longer = max(max(e["width"], e["height"]) for e in entries)
        holds, evidence = finer_than_sharp([photo.quality.loss_at_half for photo in self.read.values()], longer)
        rule, half, full = self.options.resolution, f"photos kept at {longer // 2} pixels", f"photos kept at {longer} pixels"
        if decide_skip(self.monitor, "resolution", rule, holds, evidence, half, full):
            for entry in entries:
                _halve(self.out, entry)

    def _read_poses(self, path: Path, listing: list[str]) -> dict[str, Any]:
        """Read the given poses at the size of the working photos, and write them."""
        with self.monitor.part("poses"):
            given: Given = read_poses(path, listing, {relative: photo.size for relative, photo in self.read.items()})
            cameras = []
            for relative, photo in self.read.items():
                if relative in given.cameras:
                    camera = given.cameras[relative].scaled(photo.entry["width"], photo.entry["height"])
                    cameras.append(replace(camera, name=photo.entry["name"]))
            folder = self.out / "poses"
            folder.mkdir()
            CameraSet(tuple(cameras)).save(folder / "cameras.json")
            if given.points is not None:
                write_cloud(folder / "points.ply", given.points, given.colours if given.colours is not None else given.points * 0)
        without = [photo.entry["name"] for relative, photo in self.read.items() if relative not in given.cameras]
        if without:
            self.monitor.warn(f"{len(without)} photos have no pose in {path.name} ({shortlist(without)}) and will not be used.")
        if given.missing:
            self.monitor.warn(f"{len(given.missing)} frames of {path.name} have no photo ({shortlist(list(given.missing))}).")
        self.monitor.decide("given poses", f"{len(cameras)} of {len(self.read)} photos", path.name)
        return {"poses": path.name, "posed": len(cameras), "frames_without_photo": len(given.missing)}


def photo_names(paths: dict[str, Path]) -> dict[str, str]:
    """Name of each photo by its relative path: the path without suffix, folders joined by "_". Raises BadInputError when two collide."""
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for relative in paths:
        name = relative.rsplit(".", 1)[0].replace("/", "_")
        if name in taken:
            raise BadInputError(f"The photos {taken[name]} and {relative} would both be called {name}; rename or remove one.")
        taken[name] = relative
        names[relative] = name
    return names


def _in_order(submit: Callable[[str], Future[_Photo]], items: list[str], ahead: int) -> Iterator[tuple[str, Future[_Photo]]]:
    """Submit at most `ahead` items before the first of them is taken: memory stays bounded for any number of photos."""
    waiting: list[tuple[str, Future[_Photo]]] = []
    for item in items:
        waiting.append((item, submit(item)))
        if len(waiting) >= ahead:
            yield waiting.pop(0)
    yield from waiting


def _read_one(path: Path, relative: str, name: str, source: _MaskSource | None, out: Path, max_size: int) -> _Photo:
    """One photo and its mask (none without a `source`) to working files; runs in a thread."""
    photo = read_photo(path)
    mask = None if source is None else mask_of(photo, relative, source.file, source.invert)
    rgb, mask = to_working(photo, mask, max_size)
    height, width = rgb.shape[:2]
    quality = measure(rgb, mask)
    write_png(out / "photos" / f"{name}.png", rgb)
    if mask is not None:
        write_png(out / "masks" / f"{name}.png", mask)
    focal = focal_pixels(photo.tags, photo.width, photo.height)
    entry = {
        "name": name,
        "file": f"photos/{name}.png",
        "mask": None if mask is None else f"masks/{name}.png",
        "width": width,
        "height": height,
        "source": relative,
        "source_width": photo.width,
        "source_height": photo.height,
        "focal_px": None if focal is None else focal * max(width, height) / max(photo.width, photo.height),
        "camera_model": camera_key(photo.tags),
        "blur": quality.blur,
        "exposure": quality.exposure,
        "duplicate_of": None,
    }
    return _Photo(entry, PhotoSize(photo.width, photo.height, photo.orientation), quality)


def _halve(out: Path, entry: dict[str, Any]) -> None:
    """Write a working photo and its mask again at half the size, and correct the size in `entry`."""
    bgr: Any = cv2.imread(str(out / entry["file"]), cv2.IMREAD_COLOR)
    full = np.ascontiguousarray(bgr[..., ::-1])
    mask: Any = None if entry["mask"] is None else cv2.imread(str(out / entry["mask"]), cv2.IMREAD_GRAYSCALE)
    before = max(entry["width"], entry["height"])
    rgb, mask = to_working(RawPhoto(full, None, 1, {}), mask, before // 2)
    write_png(out / entry["file"], rgb)
    if mask is not None:
        write_png(out / entry["mask"], mask)
    entry["height"], entry["width"] = rgb.shape[:2]
    if entry["focal_px"] is not None:
        entry["focal_px"] *= max(rgb.shape[:2]) / before
