"""Structure from motion of a capture, or triangulation with given poses, as jobs of the COLMAP process."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gsbake.capture.photos.undistortion import intrinsics_key
from gsbake.capture.sfm.mask_agreement import mask_agreement
from gsbake.capture.sfm.pairs import choose_matching
from gsbake.capture.sfm.process import JobCallbacks, run_job
from gsbake.capture.sfm.static_background import is_background_static
from gsbake.config.schema import Poses
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.monitor import Monitor
from gsbake.text import shortlist

#: Time limit of triangulation with given poses in seconds, per photo and at least. Far above any measured time: it ends a process that
#: hangs, and the run with it.
SECONDS_PER_PHOTO, MIN_SECONDS = 60.0, 1800.0
#: Agreement of cameras and masks (`mask_agreement`) below which features of whole photos are not trusted.
MIN_AGREEMENT = 0.85


@dataclass(frozen=True)
class Solved:
    """Cameras in the input frame, the file of triangulated points (may be absent), and the figures."""

    cameras: list[Camera]
    cloud: Path
    figures: dict[str, Any]


@dataclass(frozen=True)
class _Attempt:
    """A solution: the COLMAP process's `result`, the `cameras`, the `folder` of its files, and whether features are `masked`."""

    result: dict[str, Any]
    cameras: list[Camera]
    folder: Path
    masked: bool


@dataclass(frozen=True)
class PoseSolver:
    """Solver of one capture: the artifact folder `ingest`, its photo `entries`, and the folder `scratch` for COLMAP's files."""

    ingest: Path
    entries: Sequence[dict[str, Any]]
    scratch: Path
    options: Poses
    seed: int
    threads: int
    monitor: Monitor

    @property
    def folder(self) -> Path:
        """Folder of the results: `cameras.json`, `points.ply` and `sparse/` (COLMAP binary model)."""
        return self.scratch / "solve"

    def solve(self) -> Solved:
        """Run structure from motion. Raises BadInputError when too few photos register."""
        names = sorted(e["name"] for e in self.entries)
        kind, evidence = choose_matching(self.options.matching, names)
        self.monitor.decide("matching", kind, evidence)
        found = self._checked(self._attempt(kind, self._feature_masks()), kind)
        result = found.result
        count, missing = int(result["registered"]), list(result["missing"])
        if count < max(3, self.options.min_registered * len(names)):
            raise BadInputError(
                f"Structure from motion registered only {count} of {len(names)} photos (not {shortlist(missing)}); take sharp photos "
                "that overlap by two thirds, with texture in view, remove those of other places, or try poses.matching=exhaustive and more "
                "poses.max_features."
            )
        if missing:
            self.monitor.warn(f"{len(missing)} of {len(names)} photos could not be registered and were dropped ({shortlist(missing)}).")
        error = f"reprojection error {result['reprojection_px']:.2f} px"
        self.monitor.decide("structure from motion", f"{count} of {len(names)} photos registered", error)
        figures = {
            "registered": count,
            "registered_share": count / len(names),
            "not_registered": missing,
            "reprojection_px": result["reprojection_px"],
            "points": result["points"],
            "track_length": result["track_length"],
            "cameras": len(_lenses(self.entries)),
            "matching": kind,
            "masked_features": found.masked,
            "fine_features": result["fine_features"],
            "seconds": result["seconds"],
        }
        if found.folder != self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)
            found.folder.rename(self.folder)
        return Solved(found.cameras, self.folder / "points.ply", figures)

    def _attempt(self, matching: str, masks: Path | None) -> _Attempt:
        """Structure from motion with features in whole photos, or inside `masks`; each has a database of its own."""
        suffix = "" if masks is None else "_masked"
        folder = self.scratch / f"solve{suffix}"
        job = self._job("solve", self.entries, masks) | {"matching": matching, "mapper": self.options.mapper}
        job["work"] = str(self.scratch / f"colmap{suffix}")
        result = self._run(job, folder)
        cameras = list(CameraSet.load(folder / "cameras.json").cameras) if result["registered"] else []
        return _Attempt(result, cameras, folder, masks is not None)

    def _checked(self, found: _Attempt, matching: str) -> _Attempt:
        """`found`, or a second attempt with features inside the masks where these contradict the first one and agree better with it."""
        masks = {e["name"]: self.ingest / e["mask"] for e in self.entries if e["mask"]}
        if found.masked or self.options.masked_features is False or len(masks) < len(self.entries):
            return found

        def agreement(attempt: _Attempt) -> float:
            """Of all photos: those that are not registered agree with nothing."""
            return mask_agreement(attempt.cameras, masks) * len(attempt.cameras) / len(self.entries) if attempt.cameras else 0.0

        before = agreement(found)
        if before >= MIN_AGREEMENT:
            return found
        other = self._attempt(matching, self._write_feature_masks())
        after = agreement(other)
        chosen = other if after > before else found
        evidence = f"masks agree with the cameras to {before:.2f} with features of whole photos, {after:.2f} inside the masks"
        self.monitor.decide("features", "inside the masks" if chosen.masked else "in whole photos", evidence)
        return chosen

    def triangulate(self) -> Solved:
        """Tie points for given poses, from the given model or triangulated. Raises BadInputError with fewer than 3 poses."""
        cameras = list(CameraSet.load(self.ingest / "poses" / "cameras.json").cameras)
        if len(cameras) < 3:
            raise BadInputError(f"Only {len(cameras)} photos have a pose in the given file; at least 3 are needed.")
        figures: dict[str, Any] = {"registered": len(cameras), "registered_share": len(cameras) / len(self.entries), "points": 0}
        known = self.ingest / "poses" / "points.ply"
        if known.exists():
            self.monitor.decide("tie points", "given", "the given model has tie points")
            return Solved(cameras, known, figures)
        posed = {c.name for c in cameras}
        job = self._job("triangulate", [e for e in self.entries if e["name"] in posed], None)
        job |= {"cameras": str(self.ingest / "poses" / "cameras.json"), "lenses": _given_lenses(cameras)}
        limit = max(MIN_SECONDS, SECONDS_PER_PHOTO * len(cameras))
        cloud = self.folder / "points.ply"
        solved = self._run(job, self.folder, limit)
        figures |= {k: solved[k] for k in ("points", "reprojection_px", "track_length", "seconds")}
        self.monitor.decide("tie points", f"{solved['points']} triangulated", "with the given poses")
        return Solved(cameras, cloud, figures)

    def _job(self, task: str, entries: Sequence[dict[str, Any]], masks: Path | None) -> dict[str, Any]:
        """Description of a job for the COLMAP process."""
        options = self.options
        return {
            "task": task,
            "photos": str(self.ingest / "photos"),
            "masks": None if masks is None else str(masks),
            "work": str(self.scratch / "colmap"),
            "lenses": _lenses(entries),
            "max_features": options.max_features,
            "peak_threshold": options.peak_threshold,
            "max_size": options.max_size,
            "fine": options.fine_features,
            "threads": self.threads,
            "seed": self.seed,
        }

    def _run(self, job: dict[str, Any], folder: Path, limit: float | None = None) -> dict[str, Any]:
        """Run the COLMAP process, with its results in `folder`, and time its parts.

        Raises what `run_job` raises, and what the monitor raises on a stop request.
        """
        work = Path(job["work"])
        if not _database_is_intact(work / "database.db"):
            self.monitor.warn("COLMAP's database of the interrupted run is damaged; structure from motion starts over.")
            shutil.rmtree(work)
        work.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        with ExitStack() as part_timer:
            current = ""

            def progress(part: str, done: int, total: int) -> None:
                nonlocal current
                if part != current:
                    part_timer.close()
                    part_timer.enter_context(self.monitor.part(part))
                    current = part
                self.monitor.progress(done, total, part)

            result = run_job(job, folder, JobCallbacks(progress, self.monitor.stop_requested), limit)
        if result is None:
            self.monitor.check_stop()
            raise InterruptedRun("Stopped on request.")
        return result

    def _feature_masks(self) -> Path | None:
        """Folder of masks under COLMAP's file names when features are detected inside the masks only, else None."""
        masked = [e for e in self.entries if e["mask"]]
        if self.options.masked_features is False or not masked:
            return None
        if self.options.masked_features == "auto":
            if len(masked) < len(self.entries):
                return None
            static, evidence = is_background_static([(self.ingest / e["file"], self.ingest / e["mask"]) for e in self.entries])
            self.monitor.decide("features", "inside the masks" if static else "in whole photos", evidence)
            if not static:
                return None
        return self._write_feature_masks()

    def _write_feature_masks(self) -> Path:
        """Copy the masks under COLMAP's file names; their folder."""
        folder = self.scratch / "feature_masks"
        folder.mkdir(parents=True, exist_ok=True)
        for entry in (e for e in self.entries if e["mask"]):
            target = folder / f"{entry['name']}.png.png"
            with suppress(FileNotFoundError):
                target.unlink()
            shutil.copyfile(self.ingest / entry["mask"], target)
        return folder


def _database_is_intact(path: Path) -> bool:
    """Whether an SQLite database passes its own check; True where there is none."""
    if not path.exists():
        return True
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)) as base:
            return bool(base.execute("PRAGMA integrity_check").fetchone() == ("ok",))
    except sqlite3.Error:
        return False


def _lenses(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Photos grouped by shared intrinsics: photo size, and camera and focal length from EXIF."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for entry in entries:
        groups.setdefault((entry["width"], entry["height"], entry["camera_model"]), []).append(entry)
    lenses = []
    for (width, height, _), members in groups.items():
        focals = sorted(e["focal_px"] for e in members if e["focal_px"])
        focal = focals[len(focals) // 2] if focals else None
        lenses.append({"names": [e["name"] for e in members], "width": width, "height": height, "focal": focal})
    return lenses


def _given_lenses(cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """Photos grouped by their given intrinsics."""
    groups: dict[tuple[float, ...], list[Camera]] = {}
    for camera in cameras:
        groups.setdefault(intrinsics_key(camera), []).append(camera)
    return [
        {"names": [c.name for c in members], "width": members[0].width, "height": members[0].height, "focal": None}
        for members in groups.values()
    ]
