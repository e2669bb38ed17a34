"""Ingestion of a capture: photos, masks and known poses are converted to upright 8-bit working photos with quality measures."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from blake3 import blake3

from gsbake.capture.masks.matching import match_masks
from gsbake.capture.masks.saliency import SaliencyNetwork
from gsbake.capture.masks.weights import INSTALL, WEIGHTS, resolve_network
from gsbake.capture.photos.conversion import FULL_MASKS, ORIGINALS, Conversion, ConvertedPhoto, halve
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.exif import is_recropped
from gsbake.capture.photos.quality import find_blurred, find_near_duplicates
from gsbake.capture.photos.reader_pool import MAX_READERS, ReaderPool, submit_bounded
from gsbake.capture.photos.sharpness import detect_oversampling
from gsbake.capture.photos.video_process import extract_frames
from gsbake.capture.posed_photos import REGION
from gsbake.capture.poses.frame_masks import frame_masks, masks_by_photo
from gsbake.capture.poses.frames import GivenPoses, PhotoIndex, PhotoSize
from gsbake.capture.poses.given import read_poses
from gsbake.capture.sources import is_video, list_photos
from gsbake.config.schema import Ingest
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.ply import write_cloud
from gsbake.imaging.png import write_png
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip
from gsbake.system.names import portable_name, same_file_key
from gsbake.text import missing_list, shortlist

#: Why a photo is skipped that the settings leave out.
LEFT_OUT = "left out by the settings"
#: Folders of what is written for each photo; empty ones are removed.
SUBFOLDERS = ("photos", "masks", ORIGINALS, FULL_MASKS)
#: Folder of the frames of a video, while they are read.
FRAMES = "frames"
#: Share of the pixels of the largest photo of a camera below which another is taken for a crop.
MIN_SAME_SIZE = 0.98


@dataclass(frozen=True)
class IngestOptions:
    """Settings of ingestion; `resolution` is the rule for skipping redundant resolution, `originals` keeps what is larger than the working
    photos."""

    ingest: Ingest = Ingest()
    resolution: Rule = "auto"
    originals: bool = True


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
    """Decode, check and downsample all photos of the folder or video `photos`; write the working files into the folder `out`; the figures.

    Written: `photos/<name>.png` and `masks/<name>.png` (8-bit), `guesses/<name>.png` where masks are guessed, `photos.json` (metadata of
    each photo, and the skipped files), `originals/` (photos that are larger than the working size, as they are) and `full_masks/<name>.png`
    (their masks at their size), and with known `poses` (a file or folder that `read_poses` reads) `poses/cameras.json` and
    `poses/points.ply`, `poses/region.json` where the file has one. Raises BadInputError when too few photos are usable, or required masks
    are missing.
    """
    run = _Ingestion(photos, out, options or IngestOptions(), masks, poses, threads, monitor)
    return run.run()


@dataclass
class _Ingestion:
    """One run; `read` maps the path of each usable photo, relative to the folder, to its metadata."""

    folder: Path
    out: Path
    options: IngestOptions
    mask_folder: Path | None
    poses: Path | None
    threads: int
    monitor: Monitor
    skipped: list[dict[str, str]] = field(default_factory=list)
    read: dict[str, ConvertedPhoto] = field(default_factory=dict)
    video: Path | None = None

    def run(self) -> dict[str, Any]:
        """Execute all steps; returns the figures."""
        settings = self.options.ingest
        if is_video(self.folder):
            self._extract_frames()
        paths = {path.relative_to(self.folder).as_posix(): path for path in list_photos(self.folder)}
        names = photo_names(paths)
        use_masks = settings.masks != "ignore"
        masks = self._match_masks(paths) if use_masks else {}
        self._leave_out(paths)
        with self.monitor.part("duplicates"):
            self._skip_identical_files(paths)
        with self.monitor.part("photos"):
            self._read_all(paths, names, masks)
        if len(self.read) < settings.min_photos:
            first = self.skipped[0] if self.skipped else None
            skipped = f" ({len(self.skipped)} of {len(names)} were skipped: {first['source']}: {first['why']})" if first else ""
            raise BadInputError(
                f"{self.folder} has {len(self.read)} usable photos{skipped}, but at least {settings.min_photos} are needed; "
                "take more photos from all sides of the object."
            )
        self._report_quality()
        self._report_crops()
        self._report_gain_maps()
        self._report_masks(masks)
        with self.monitor.part("resolution"):
            self._reduce_resolution()
        if self.video is not None:
            shutil.rmtree(self.folder)
        guesses = self._guess_masks()
        results = {"poses": "none"} if self.poses is None else self._read_poses(self.poses, list(names))
        entries = self._entries
        (self.out / "photos.json").write_bytes(json.dumps({"photos": entries, "skipped": self.skipped}, indent=1).encode())
        blur = sorted(e["blur"] for e in entries)
        return {
            "photos": len(entries),
            "skipped": len(self.skipped),
            "masks": sum(e["mask"] is not None for e in entries),
            "guessed_masks": guesses,
            "near_duplicates": sum(e["duplicate_of"] is not None for e in entries),
            "blur_median": blur[len(blur) // 2],
            "megapixels": sum(e["width"] * e["height"] for e in entries) / 1e6,
            **results,
        }

    def _match_masks(self, paths: dict[str, Path]) -> dict[str, Path]:
        """Mask files by photo: those that frames of the poses name, and those of the mask folder."""
        by_frame = frame_masks(self.poses)
        named = masks_by_photo(by_frame, self.mask_folder, paths, self.poses) if self.poses is not None else {}
        if by_frame and not named:
            self.monitor.decide("mask_path", "not used", f"{len(by_frame)} frames name a mask; other masks were given")
        return named if self.mask_folder is None else match_masks(self.mask_folder, paths, named)

    @property
    def _entries(self) -> list[dict[str, Any]]:
        return [photo.entry for photo in self.read.values()]

    def _extract_frames(self) -> None:
        """Replace the video by a folder of its frames, which is removed when they are read."""
        self.video, self.folder = self.folder, self.out / FRAMES
        self.folder.mkdir(exist_ok=True)
        with self.monitor.part("frames"):
            settings = self.options.ingest
            written, total, transfer = extract_frames(self.video, self.folder, settings.frames, settings.max_megapixels)
        self.monitor.decide("frames", f"{written} of {total}", "the sharpest of equal stretches of the video's motion")
        if transfer:
            self.monitor.decide("colours of the video", f"{transfer} undone", "reference white becomes white, what is brighter is clipped")

    def _leave_out(self, paths: dict[str, Path]) -> None:
        """Remove from `paths` what the settings leave out, by path or by file name. Raises BadInputError for a name of no photo."""
        named = set()
        for name in self.options.ingest.leave_out:
            found = [name] if name in paths else [relative for relative in paths if relative.rsplit("/", 1)[-1] == name]
            if len(found) != 1:
                number = len(found) or "none"
                raise BadInputError(f"ingest.leave_out names '{name}', which is {number} of the photos; write its path in their folder.")
            named.add(found[0])
        for relative in sorted(named):
            self.skipped.append({"source": relative, "why": LEFT_OUT})
            del paths[relative]

    def _skip_identical_files(self, paths: dict[str, Path]) -> None:
        """Remove from `paths` files that cannot be read or are identical to an earlier one."""
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
        """Decode, downsample, measure and write all photos in a pool of processes; unreadable ones are skipped with a warning."""
        for sub in SUBFOLDERS:
            (self.out / sub).mkdir(exist_ok=True)
        settings, count = self.options.ingest, max(1, min(self.threads, MAX_READERS, len(paths)))
        with ReaderPool(count) as readers, ThreadPoolExecutor(count) as pool:

            def submit(relative: str) -> Future[ConvertedPhoto]:
                what = Conversion(
                    paths[relative], relative, names[relative], self.out, settings.masks != "ignore", masks.get(relative),
                    settings.invert_masks, settings.max_size, settings.max_megapixels, self.options.originals,
                )  # fmt: skip
                return pool.submit(readers.convert, what)

            try:
                for done, (relative, future) in enumerate(submit_bounded(submit, list(paths), 2 * max(1, self.threads))):
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
        self._remove_empty_folders()

    def _remove_empty_folders(self) -> None:
        for sub in SUBFOLDERS:
            folder = self.out / sub
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()

    def _report_quality(self) -> None:
        """Mark near-duplicates; warn about them and about blurred photos."""
        entries = self._entries
        duplicates = find_near_duplicates([photo.quality.thumbnail for photo in self.read.values()])
        for entry, earlier in zip(entries, duplicates, strict=True):
            if earlier is not None:
                entry["duplicate_of"] = entries[earlier]["name"]
        pairs = [f"{e['name']} = {e['duplicate_of']}" for e in entries if e["duplicate_of"]]
        if pairs:
            self.monitor.warn(f"{len(pairs)} photos are near-duplicates of others ({shortlist(pairs)}).")
        outliers = find_blurred([e["blur"] for e in entries])
        if outliers:
            names = shortlist([entries[i]["name"] for i in outliers])
            self.monitor.warn(f"{len(outliers)} photos are much more blurred than the rest ({names}).")

    def _report_gain_maps(self) -> None:
        """Report photos whose gain maps were applied, and warn about others."""
        applied, names = ([e["name"] for e in self._entries if e["gain_map"] == state] for state in ("applied", "not used"))
        if applied:
            self.monitor.decide("gain maps", f"applied to {len(applied)} photos", "tone mapping is undone; 1 is white of ordinary screens")
        if names:
            self.monitor.warn(
                f"{len(names)} photos have a gain map for HDR screens, which is not used ({shortlist(names)}): highlights clip as they do "
                "on other screens; take photos without HDR, or RAW."
            )

    def _report_crops(self) -> None:
        """Warn about photos that were cropped after their camera wrote EXIF, and take no focal length from it.

        A crop of the same aspect ratio looks like a reduced photo, unless others of its camera were not reduced as much.
        """
        largest: dict[tuple[Any, ...], int] = {}
        for entry in self._entries:
            largest[_written(entry)] = max(largest.get(_written(entry), 0), entry["source_width"] * entry["source_height"])
        cropped = []
        for entry in self._entries:
            size = entry["source_width"], entry["source_height"]
            if entry["written_size"] and (
                is_recropped(entry["written_size"], size) or size[0] * size[1] < MIN_SAME_SIZE * largest[_written(entry)]
            ):
                cropped.append(entry["name"])
                entry["focal_px"] = None
        if cropped:
            self.monitor.warn(
                f"{len(cropped)} photos seem cropped, for EXIF tells of more of the picture ({missing_list(cropped)}); poses are better "
                "from whole photos."
            )

    def _report_masks(self, masks: dict[str, Path]) -> None:
        """Report how many photos have masks, and their sources. Raises BadInputError when required masks are missing."""
        setting, total = self.options.ingest.masks, len(self.read)
        without = [entry["name"] for entry in self._entries if entry["mask"] is None]
        count = total - len(without)
        if without and setting == "require":
            raise BadInputError(
                f"{len(without)} of {total} photos have no mask ({missing_list(without)}), but ingest.masks is require; "
                "give them masks or set it to auto."
            )
        files = sum(relative in masks for relative in self.read)
        given = f"{count} of {total} photos have one: {files} mask files, {count - files} alpha channels" if count else "no photo has one"
        self.monitor.decide("masks", "used" if count else "none", "set by the profile" if setting == "ignore" else given)
        if count and without and not self._makes_masks:
            self.monitor.warn(f"{len(without)} of {total} photos have no mask ({missing_list(without)}); give every photo one.")

    @property
    def _makes_masks(self) -> bool:
        """Whether masks that are missing are guessed."""
        return self.options.ingest.masks == "auto" and resolve_network(self.options.ingest.mask_network) != "none"

    def _guess_masks(self) -> int:
        """Write the network's guess for each photo without a mask; returns their number."""
        for entry in self._entries:
            entry["guess"] = None
        without = [entry for entry in self._entries if entry["mask"] is None]
        if not without or self.options.ingest.masks != "auto":
            return 0
        if not self._makes_masks:
            missing = not WEIGHTS.is_file()
            reason = "its weights are not installed" if missing else "set by the profile"
            self.monitor.decide("automatic masks", "none", f"no mask network is used; {reason}")
            if missing:
                self.monitor.warn(f"Masks are not made, because the network's weights are not installed; run `{INSTALL}`, then this again.")
            return 0
        (self.out / "guesses").mkdir()
        with self.monitor.part("mask guesses"):
            network = SaliencyNetwork(self.threads)
            for done, entry in enumerate(without):
                self.monitor.check_stop()
                self.monitor.progress(done, len(without), "mask guesses")
                bgr: Any = cv2.imread(str(self.out / entry["file"]), cv2.IMREAD_COLOR)
                entry["guess"] = f"guesses/{entry['name']}.png"
                write_png(self.out / entry["guess"], network.probability(np.ascontiguousarray(bgr[..., ::-1])))
        evidence = f"{len(without)} of {len(self._entries)} photos have no mask; agreement between photos corrects the guesses"
        self.monitor.decide("automatic masks", "guessed by u2netp", evidence)
        return len(without)

    def _reduce_resolution(self) -> None:
        """Halve the working photos and masks when the photos are oversampled."""
        entries = self._entries
        longer = max(max(e["width"], e["height"]) for e in entries)
        oversampled, evidence = detect_oversampling([photo.quality.halving_loss for photo in self.read.values()], longer)
        rule, half, full = self.options.resolution, f"photos kept at {longer // 2} pixels", f"photos kept at {longer} pixels"
        if decide_skip(self.monitor, "resolution", rule, oversampled, evidence, half, full):
            for entry in entries:
                halve(self.out, entry)
            self._remove_empty_folders()

    def _read_poses(self, path: Path, listing: list[str]) -> dict[str, Any]:
        """Read the given poses, scale them to the working photos and write them."""
        with self.monitor.part("poses"):
            given: GivenPoses = read_poses(path, listing, {relative: _size(photo) for relative, photo in self.read.items()})
            cameras = []
            for relative, photo in self.read.items():
                if relative in given.cameras:
                    camera = given.cameras[relative].scaled(photo.entry["width"], photo.entry["height"])
                    cameras.append(replace(camera, name=photo.entry["name"]))
            folder = self.out / "poses"
            folder.mkdir()
            CameraSet(tuple(cameras)).save(folder / "cameras.json")
            if given.region is not None:
                (folder / REGION).write_bytes(json.dumps(given.region.document).encode())
            if given.points is not None:
                write_cloud(folder / "points.ply", given.points, given.colours if given.colours is not None else given.points * 0)
        without = [photo.entry["name"] for relative, photo in self.read.items() if relative not in given.cameras]
        for note in given.notes:
            self.monitor.decide(*note)
        for warning in given.warnings:
            self.monitor.warn(warning)
        if without:
            self.monitor.warn(f"{len(without)} photos have no pose in {path.name} ({missing_list(without)}) and will not be used.")
        left_out = PhotoIndex(photo["source"] for photo in self.skipped if photo["why"] == LEFT_OUT)
        missing = [frame for frame in given.missing if left_out.match(frame) is None]
        if missing:
            self.monitor.warn(f"{len(missing)} frames of {path.name} have no photo ({missing_list(missing)}).")
        self.monitor.decide("given poses", f"{len(cameras)} of {len(self.read)} photos", path.name)
        return {"poses": path.name, "posed": len(cameras), "frames_without_photo": len(missing)}


def _written(entry: dict[str, Any]) -> tuple[Any, ...]:
    """Camera and the size that it wrote: photos in which both are equal were the same size."""
    return entry["camera_model"], entry["camera_body"], *(entry["written_size"] or ())


def _size(photo: ConvertedPhoto) -> PhotoSize:
    return PhotoSize(photo.entry["source_width"], photo.entry["source_height"], photo.orientation)


def photo_names(paths: dict[str, Path]) -> dict[str, str]:
    """Name of each photo by its relative path: the path without suffix, folders joined by "_". Raises BadInputError when two collide,
    on this system or another, which does not tell capitals from small letters.

    Names that some system refuses are shortened and end with a digest.
    """
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for relative in paths:
        name = portable_name(relative.rsplit(".", 1)[0].replace("/", "_"))
        other = taken.setdefault(same_file_key(name), relative)
        if other != relative:
            raise BadInputError(f"The photos {other} and {relative} would both be called {name}; rename or remove one.")
        names[relative] = name
    return names
