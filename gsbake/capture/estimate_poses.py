"""Pose estimation: cameras from structure from motion or from given poses, undistorted photos, and the unit frame of the object."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.region import holds_object
from gsbake.capture.hull.visual_hull import visual_hull
from gsbake.capture.masks.completion import complete_masks
from gsbake.capture.masks.consensus import MIN_CERTAIN_OVERLAP, MIN_OVERLAP, MIN_USED_AGREEMENT, correct_mask, distorted, find_consensus
from gsbake.capture.masks.grab_cut import border_by_colour
from gsbake.capture.masks.hull_correction import apply_correction, correct_by_hull
from gsbake.capture.masks.support_plane import plane_masks
from gsbake.capture.photos.conversion import file_digest
from gsbake.capture.photos.redundancy import find_redundant_photos
from gsbake.capture.photos.replaced import require_sizes
from gsbake.capture.photos.undistortion import intrinsics_key, pinhole_camera, remap_tables, resample
from gsbake.capture.posed_photos import DIGESTS, REGION, PosedPhotos
from gsbake.capture.poses.normalisation import BoundingSphere, bounding_sphere_from_masks, bounding_sphere_from_views
from gsbake.capture.sfm.feature_masks import FeatureMasks
from gsbake.capture.sfm.solve import PoseSolver, Solved
from gsbake.config.schema import Poses
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.ply import read_cloud, write_cloud
from gsbake.geometry.region import Region
from gsbake.imaging.png import read_grey, write_png
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip
from gsbake.text import shortlist

#: Agreement of the network's guesses from which no others are tried.
CERTAIN_AGREEMENT = 0.95
#: Agreement from which guesses are used where cameras stand before a turntable.
MIN_TABLE_AGREEMENT = 0.7
#: Smallest number of tie points that is written: fewer do not describe the shape.
MIN_POINTS = 30
#: Surface points at which the coverage of photos is measured.
SURFACE_POINTS = 1000
#: Share of a mask's area whose correction by the visual hull is worth a line.
LARGE_CORRECTION = 0.01
#: What is wrong with a region outside of which the whole object lies.
REGION_MISSES = (
    "poses: the region lies in no photo, or beside the object in the masks; its box is in the frame of the cameras (photo_cameras.json)."
)
#: Longer side in pixels of the masks that visual hulls are carved from.
HULL_MASK_SIZE = 512


@dataclass(frozen=True)
class PoseOptions:
    """Settings of pose estimation; `redundant_photos` is the rule for skipping redundant photos."""

    poses: Poses = Poses()
    redundant_photos: Rule = "auto"


def estimate_poses(
    ingest: Path,
    out: Path,
    options: PoseOptions | None = None,
    *,
    seed: int = 0,
    threads: int = 2,
    scratch: Path | None = None,
    cache: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Estimate the cameras of the photos in the artifact folder `ingest`, write the posed capture into `out`; return the figures.

    Written: `cameras.json` (`CameraSet`, unit frame), `photos/`, `masks/` (pinhole), `points.ply` (tie points, unit frame; may be absent),
    `region.json` (the box outside of which nothing is baked, where there is one), `photo_masks/` (masks that were guessed, as the photos
    show them), `photo_cameras.json` (cameras of the photos before undistortion, world frame), `photo_digests.json` (of the pinhole photos:
    one replaced by hand is known by it), `sparse/` (COLMAP binary model, input frame).
    `scratch` holds the database of COLMAP, from which an interrupted run resumes; `cache` keeps features and matches, which a run with more
    photos uses again. Raises BadInputError when too few photos register, required poses are missing, or the region lies in no photo.
    """
    if scratch is None:
        with tempfile.TemporaryDirectory(prefix="gsbake-poses-") as folder:
            scratch = Path(folder)
            return estimate_poses(ingest, out, options, seed=seed, threads=threads, scratch=scratch, cache=cache, monitor=monitor)
    run = _Estimation(ingest, out, options or PoseOptions(), seed, threads, scratch, cache, monitor)
    return run.run()


@dataclass
class _Estimation:
    """One run."""

    ingest: Path
    out: Path
    options: PoseOptions
    seed: int
    threads: int
    scratch: Path
    cache: Path | None
    monitor: Monitor

    def run(self) -> dict[str, Any]:
        """Execute all steps; returns the figures."""
        monitor = self.monitor
        entries: list[dict[str, Any]] = json.loads((self.ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
        require_sizes(self.ingest, {entry["name"]: (entry["width"], entry["height"]) for entry in entries}, "ingest")
        solver = PoseSolver(self.ingest, entries, self.scratch, self.options.poses, self.seed, self.threads, monitor, self.cache)
        given = self._use_given(len(entries))
        solved = solver.triangulate() if given else solver.solve()
        CameraSet(tuple(solved.cameras), poses="given" if given else "solved").save(self.out / "photo_cameras.json")
        points, colours = read_cloud(solved.cloud) if solved.cloud.exists() else (None, None)
        with monitor.part("automatic masks"):
            automatic = self._write_automatic_masks(entries, solved, points)
        with monitor.part("undistortion"):
            pinholes = self._undistort(solved.cameras)
        region = self._region(given)
        with monitor.part("normalisation"):
            if region is not None:
                points, colours = self._cut(region, pinholes, points, colours)
            masks = self._hull_masks(pinholes)
            sphere = self._bounding_sphere(pinholes, masks, points, region)
        to_world = sphere.similarity()
        to_unit = to_world.inverse()
        origin = "given" if given else "solved"
        flash = {entry["name"]: entry.get("flash") for entry in entries}
        cameras = [replace(c.moved(to_unit), flash=flash[c.name]) for c in pinholes]
        cloud = None if points is None or len(points) < MIN_POINTS else to_unit.apply(points)
        if cloud is not None:
            write_cloud(self.out / "points.ply", cloud, colours if colours is not None else cloud * 0)
        with monitor.part("masks"):
            self._complete_masks([(camera.moved(to_unit), mask) for camera, mask in masks], cloud)
        with monitor.part("redundant photos"):
            cameras, dropped = self._drop_redundant(entries, cameras, cloud)
        CameraSet(tuple(cameras), to_world, origin, epipolar_px=solved.figures.get("epipolar_px")).save(self.out / "cameras.json")
        if (solver.folder / "sparse").exists():
            shutil.copytree(solver.folder / "sparse", self.out / "sparse")
        if region is None:
            cube = Region(sphere.centre, np.full(3, 2 * sphere.radius), np.eye(3))
            monitor.decide("region", "none", f"the object fits into {json.dumps(_rounded(cube))}, a file for --region to start from")
        monitor.decide("unit frame", f"radius {sphere.radius:.4g} in world units", sphere.evidence)
        centre = sphere.centre.tolist()
        return {"poses": origin, **solved.figures, **automatic, "dropped_photos": dropped, "centre": centre, "radius": sphere.radius}

    def _use_given(self, photos: int) -> bool:
        """Whether given poses are used. Raises BadInputError when they are required but missing."""
        source, known = self.options.poses.source, self.ingest / "poses" / "cameras.json"
        if not known.exists() and source == "given":
            raise BadInputError("No poses were given, but poses.source is given; provide poses with the photos or set it to auto.")
        use = known.exists() and source != "solve"
        count = f"given for {len(CameraSet.load(known).cameras)} of {photos} photos" if known.exists() else "none were given"
        evidence = f"{count}; set by the profile" if source != "auto" else count
        self.monitor.decide("pose source", "given" if use else "structure from motion", evidence)
        return use

    def _region(self, given: bool) -> Region | None:
        """The box to be baked, in the cameras' frame, which is written; None where there is none."""
        settings, file = self.options.poses, self.ingest / "poses" / REGION
        if settings.region == "none":
            return None
        if settings.region_box:
            region, source = Region.of(settings.region_box, "poses.region_box"), "set by --region"
        elif given and file.exists():
            region, source = Region.read(file), "from the file of the cameras"
        else:
            return None
        (self.out / REGION).write_bytes(json.dumps(region.document, indent=1).encode())
        self.monitor.decide("region", source, json.dumps(_rounded(region)))
        return region

    def _cut(self, region: Region, cameras: Sequence[Camera], points: Any, colours: Any) -> tuple[Any, Any]:
        """Take what lies outside the region from the masks; the tie points and their colours inside it."""
        shown = 0
        for camera in cameras:
            box = region.silhouette(camera)
            path = self.out / "masks" / f"{camera.name}.png"
            if path.exists():
                box = np.minimum(read_grey(path), box)
                write_png(path, box)
            shown += bool(box.any())
        if not shown:
            raise BadInputError(REGION_MISSES)
        inside = None if points is None else region.contains(points)
        return (None, None) if inside is None else (points[inside], None if colours is None else colours[inside])

    def _write_automatic_masks(self, entries: Sequence[dict[str, Any]], solved: Solved, points: Any) -> dict[str, Any]:
        """Write `photo_masks/`: guesses corrected by agreement between photos, as the photos show them; returns the figures.

        Guesses are those of the network, or of what stands on a plane among the tie `points` where these agree better. Nothing is written
        where no mask was guessed, or the guesses do not agree with the cameras. Before a turntable, where that is no question of the
        cameras, they may agree less: in all photos of a round the same part of the room looks like one of the object.
        """
        cameras = solved.cameras
        least = MIN_TABLE_AGREEMENT if solved.on_table else MIN_USED_AGREEMENT
        by_name = {e["name"]: e for e in entries}
        files = FeatureMasks(self.ingest, [by_name[c.name] for c in cameras], self.scratch).files
        guessed = [c.name for c in cameras if not by_name[c.name]["mask"] and by_name[c.name].get("guess")]
        if not guessed or len(files) < len(cameras):
            return {}
        found = find_consensus(cameras, files)
        agreement = 0.0 if found is None else found.agreement
        evidence = f"the guesses of the network agree with the cameras to {agreement:.2f}"
        photos = {c.name: self.ingest / by_name[c.name]["file"] for c in cameras}
        if not solved.on_table and agreement < CERTAIN_AGREEMENT and len(guessed) == len(cameras) and points is not None:
            sets = plane_masks(cameras, photos, files, points, self.scratch / "plane_masks", self.seed, self.threads)
            for masks, kind in zip(sets, ("", ", with the plane below it in question,"), strict=False):
                if (other := find_consensus(cameras, masks)) is not None:
                    evidence += f", masks of what stands on the support plane{kind} to {other.agreement:.2f}"
                    if other.agreement > agreement:
                        found, files, agreement = other, masks, other.agreement
        if found is None or agreement < least:
            evidence += f", which is below {least:g}"
            self.monitor.decide("automatic masks", "not used", evidence)
            return {"automatic_masks": 0, "mask_agreement": agreement}
        (self.out / "photo_masks").mkdir()

        def write(camera: Camera, silhouette: NDArray[np.bool_], overlap: float) -> None:
            full = cv2.resize(read_grey(files[camera.name]), (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
            mask = correct_mask(np.asarray(full, np.uint8), distorted(silhouette, camera), overlap)
            mask = np.where(mask > 127, 255, 0).astype(np.uint8)
            if agreement < MIN_USED_AGREEMENT:  # most guesses err at the same places, so that their border is no border
                mask = border_by_colour(_read_rgb(photos[camera.name]), mask)
            write_png(self.out / "photo_masks" / f"{camera.name}.png", mask)

        votes = zip(cameras, found.silhouettes, found.overlap.tolist(), strict=True)
        chosen = [vote for vote in votes if vote[0].name in guessed]
        with ThreadPoolExecutor(max(1, min(self.threads, 8))) as pool:
            list(pool.map(lambda vote: write(*vote), chosen))
        overlaps = {camera.name: overlap for camera, _, overlap in chosen}
        made = {name: self.out / "photo_masks" / f"{name}.png" for name in overlaps}
        self._correct_by_hull(cameras, photos, {**files, **made}, sorted(overlaps))
        doubtful = sorted((name for name in overlaps if overlaps[name] < MIN_CERTAIN_OVERLAP), key=lambda name: overlaps[name])
        corrected = sum(overlap < MIN_OVERLAP for overlap in overlaps.values())
        counts = f"{corrected} of {len(guessed)} were corrected, {len(doubtful)} are doubtful"
        self.monitor.decide("automatic masks", "used", f"{evidence}; {counts}")
        if doubtful:
            self.monitor.warn(
                f"{len(doubtful)} of {len(guessed)} automatic masks are doubtful ({shortlist(doubtful)}); edit them (`gsbake masks`)."
            )
        return {"automatic_masks": len(guessed), "mask_agreement": agreement, "corrected_masks": corrected, "doubtful_masks": doubtful}

    def _correct_by_hull(
        self, cameras: Sequence[Camera], photos: Mapping[str, Path], masks: Mapping[str, Path], guessed: Sequence[str]
    ) -> None:
        """Correct the `masks` that were `guessed`, files by photo name, by the visual hull of all of them."""
        changes: list[tuple[float, str]] = []
        for name, (certain, possible) in correct_by_hull(cameras, masks).items():
            if name in guessed:
                mask = read_grey(masks[name])
                corrected = apply_correction(mask, partial(_read_rgb, photos[name]), certain, possible)
                area = max(int((mask > 127).sum()), 1)
                changes.append((float(((corrected > 127) != (mask > 127)).sum()) / area, name))
                write_png(masks[name], np.where(corrected > 127, 255, 0).astype(np.uint8))
        large = sorted(name for share, name in changes if share >= LARGE_CORRECTION)
        if large:
            evidence = f"at least {100 * LARGE_CORRECTION:g} % of the object was missing or too much, {100 * max(changes)[0]:.1f} % at most"
            self.monitor.decide("masks corrected by the visual hull", f"{len(large)} of {len(guessed)}: {shortlist(large)}", evidence)

    def _undistort(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Write photos and masks undistorted, and return their pinhole cameras; photos without distortion are copied."""
        groups: dict[tuple[float, ...], list[Camera]] = {}
        for camera in cameras:
            groups.setdefault(intrinsics_key(camera), []).append(camera)
        (self.out / "photos").mkdir()
        if any(self._mask_file(c.name).exists() for c in cameras):
            (self.out / "masks").mkdir()
        cv2.setNumThreads(1)
        done = 0
        pinholes: dict[str, Camera] = {}
        digests: dict[str, str] = {}
        with ThreadPoolExecutor(max(1, min(self.threads, 8))) as pool:
            for members in groups.values():
                target = pinhole_camera(members[0])
                tables = remap_tables(members[0], target) if members[0].distortion else None

                def undistort(camera: Camera, tables: Any = tables, target: Camera = target) -> Camera:
                    for sub in ("photos", "masks"):
                        self._resample(sub, camera.name, tables)
                    digests[camera.name] = file_digest(self.out / "photos" / f"{camera.name}.png")
                    return replace(target, name=camera.name, R=camera.R, t=camera.t)

                for result in pool.map(undistort, members):
                    pinholes[result.name] = result
                    done += 1
                    self.monitor.progress(done, len(cameras), "undistortion")
        (self.out / DIGESTS).write_bytes(json.dumps(digests, indent=1, sort_keys=True).encode())
        return [pinholes[c.name] for c in cameras]

    def _resample(self, sub: str, name: str, tables: Any) -> None:
        """Resample one photo or mask (the folder `sub`) through `tables` of `remap_tables`, or copy it when they are None."""
        mask = sub == "masks"
        source, target = self._mask_file(name) if mask else self.ingest / sub / f"{name}.png", self.out / sub / f"{name}.png"
        if mask and not source.exists():
            return
        if tables is None:
            shutil.copyfile(source, target)
            return
        image: Any = cv2.imread(str(source), cv2.IMREAD_GRAYSCALE if mask else cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(source)
        result = resample(np.asarray(image, np.uint8), tables, mask)
        write_png(target, result if mask else np.ascontiguousarray(result[..., ::-1]))

    def _mask_file(self, name: str) -> Path:
        """The mask of a photo as it shows it: the one that this stage made, else the given one; it may be missing."""
        made = self.out / "photo_masks" / f"{name}.png"
        return made if made.exists() else self.ingest / "masks" / f"{name}.png"

    def _hull_masks(self, cameras: Sequence[Camera]) -> list[tuple[Camera, Any]]:
        """Camera and mask (None where there is none) of each photo at HULL_MASK_SIZE."""
        posed = PosedPhotos(self.out, CameraSet(tuple(cameras)))
        cv2.setNumThreads(self.threads)
        return [posed.mask(i, HULL_MASK_SIZE) for i in range(len(cameras))]

    def _bounding_sphere(
        self, cameras: Sequence[Camera], masks: Sequence[tuple[Camera, Any]], points: Any, region: Region | None
    ) -> BoundingSphere:
        """Bounding sphere of the object: from the visual hull when half of the photos have masks, else the region's, else from the
        cameras' views."""
        masked = [(camera, mask) for camera, mask in masks if mask is not None]
        if len(masked) >= max(3, 0.5 * len(cameras)):
            sphere = bounding_sphere_from_masks([c for c, _ in masked], [m for _, m in masked])
            if sphere is not None:
                return sphere
            if region is not None and not holds_object(region, masked):
                raise BadInputError(REGION_MISSES)
            self.monitor.warn("The visual hull of the masks is empty; check that white is the object (else set ingest.invert_masks).")
        if region is not None:
            return BoundingSphere(region.centre, float(np.linalg.norm(region.size)) / 2, "the region")
        return bounding_sphere_from_views(cameras, points)

    def _complete_masks(self, masks: Sequence[tuple[Camera, Any]], cloud: Any) -> None:
        """Add to mask files the regions that tie points show to be missing; `masks` as in `_hull_masks`, all in the unit frame."""
        if cloud is None or any(mask is None for _, mask in masks):
            return
        completions = complete_masks([camera for camera, _ in masks], [mask for _, mask in masks], cloud)
        names = [masks[completion.index][0].name for completion in completions]
        for completion, name in zip(completions, names, strict=True):
            path = self.out / "masks" / f"{name}.png"
            mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if mask is None:
                raise FileNotFoundError(path)
            missing = cv2.resize(255 * completion.missing.astype(np.uint8), mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
            write_png(path, np.where(missing > 127, 255, mask).astype(np.uint8))
        if completions:
            points = sum(completion.points for completion in completions)
            evidence = f"they excluded {points} tie points that nearly all others include: {shortlist(names)}"
            self.monitor.decide("mask completion", f"{len(completions)} of {len(masks)} masks", evidence)

    def _drop_redundant(self, entries: Sequence[dict[str, Any]], cameras: list[Camera], cloud: Any) -> tuple[list[Camera], list[str]]:
        """Delete the files of redundant photos; returns the remaining cameras (unit frame) and the names of the redundant photos."""
        posed = PosedPhotos(self.out, CameraSet(tuple(cameras)))

        def surface() -> tuple[Any, Any]:
            if posed.has_masks:
                return visual_hull(posed).surface_points(SURFACE_POINTS, self.seed)
            points = np.zeros((0, 3)) if cloud is None else cloud[np.linalg.norm(cloud, axis=1) < 1]
            return points[:: max(1, len(points) // SURFACE_POINTS)], None

        rule = self.options.redundant_photos
        duplicates = {e["name"]: e["duplicate_of"] for e in entries if e["duplicate_of"]}
        indices: list[int] = []
        evidence = "not searched"
        if rule != "keep":
            indices, evidence = find_redundant_photos(cameras, duplicates, surface, rule == "skip")
        names = [cameras[i].name for i in indices]
        skipped = f"{len(names)} of {len(cameras)} photos skipped ({shortlist(names)})" if names else "no photo is redundant"
        if not decide_skip(self.monitor, "redundant_photos", rule, bool(names), evidence, skipped, f"all {len(cameras)} photos used"):
            return cameras, []
        for name in names:
            for sub in ("photos", "masks"):
                (self.out / sub / f"{name}.png").unlink(missing_ok=True)
        return [c for c in cameras if c.name not in set(names)], names


def _rounded(region: Region) -> dict[str, Any]:
    """The region's document with five significant digits, for a line of text."""
    return {key: [float(f"{x:.5g}") for x in value] if key != "rotation" else value for key, value in region.document.items()}


def _read_rgb(path: Path) -> NDArray[np.uint8]:
    """The photo (h, w, 3) of a file. Raises FileNotFoundError where it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(path)
    return np.ascontiguousarray(image[..., ::-1], np.uint8)
