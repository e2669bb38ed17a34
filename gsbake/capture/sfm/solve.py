"""Structure from motion of a capture, or triangulation with given poses, as jobs of the COLMAP process."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gsbake.capture.sfm.coincidence import MAX_COINCIDING, MIN_WARNED, coinciding
from gsbake.capture.sfm.feature_masks import FeatureMasks
from gsbake.capture.sfm.lenses import given_lenses, is_plausible_lens, solved_lenses
from gsbake.capture.sfm.pairs import choose_matching
from gsbake.capture.sfm.process import JobCallbacks, run_job
from gsbake.capture.sfm.standing_background import StandingBackground, find_standing_background
from gsbake.capture.sfm.trial import FEATURES, MIN_CAPTURE, SIZE, TRIED, Region, Trial, best_region, write_small_photos
from gsbake.config.schema import Poses
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.ply import read_cloud
from gsbake.geometry.turntable import find_turntable
from gsbake.monitor import Monitor, PartSequence
from gsbake.text import shortlist

#: Time limit of triangulation with given poses in seconds, per photo and at least. Far above any measured time: it ends a process that
#: hangs, and the run with it.
SECONDS_PER_PHOTO, MIN_SECONDS = 60.0, 1800.0
#: Share of registered photos below which the other kind of features is tried too.
MIN_PLACED_SHARE = 0.85
#: Share of the cameras on exact circles from which masks are not asked about them.
MIN_TABLE_SHARE = 0.9
_FEATURES: dict[Region, str] = {
    "whole photos": "in whole photos", "moving parts": "on what moves", "masks": "inside the masks",
    "outside the masks": "outside the masks",
}  # fmt: skip
_FOLDERS: dict[Region, str] = {"whole photos": "", "moving parts": "_moving", "masks": "_masked", "outside the masks": "_outside"}


@dataclass(frozen=True)
class Solved:
    """Cameras in the input frame, the file of triangulated points (may be absent), and the figures; whether they stand `on_table`, before
    the turntable that the photos' background shows, which leaves no doubt about them."""

    cameras: list[Camera]
    cloud: Path
    figures: dict[str, Any]
    on_table: bool = False


@dataclass(frozen=True)
class _Attempt:
    """A solution: the COLMAP process's `result`, the `cameras`, the `folder` of its files, the `region` of the features, and whether the
    object was `turned` before a background that stands."""

    result: dict[str, Any]
    cameras: list[Camera]
    folder: Path
    region: Region
    turned: bool

    @cached_property
    def on_table(self) -> bool:
        """Whether cameras stand on exact circles before an object that was `turned`: wrong ones do not."""
        table = find_turntable(self.cameras) if self.turned else None
        return table is not None and table.share >= MIN_TABLE_SHARE

    @property
    def masked(self) -> bool:
        """Whether features are limited to the masks."""
        return self.region == "masks"


@dataclass(frozen=True)
class PoseSolver:
    """Solver of one capture: the artifact folder `ingest`, its photo `entries`, the folder `scratch` for COLMAP's files, and the folder
    `cache` of features and matches that outlive the run, if any."""

    ingest: Path
    entries: Sequence[dict[str, Any]]
    scratch: Path
    options: Poses
    seed: int
    threads: int
    monitor: Monitor
    cache: Path | None = None

    @property
    def folder(self) -> Path:
        """Folder of the results: `cameras.json`, `points.ply` and `sparse/` (COLMAP binary model)."""
        return self.scratch / "solve"

    def solve(self) -> Solved:
        """Run structure from motion. Raises BadInputError when too few photos register."""
        names = sorted(e["name"] for e in self.entries)
        kind, evidence = choose_matching(self.options.matching, names)
        self.monitor.decide("matching", kind, evidence)
        lenses, folders = solved_lenses(self.entries)
        if folders:
            self.monitor.decide("shared intrinsics", f"{len(lenses)} cameras", folders)
        found = self._best_attempt(kind)
        result = found.result
        count, missing = int(result["registered"]), list(result["missing"])
        if count < max(3, self.options.min_registered * len(names)):
            lost = f"Structure from motion registered only {count} of {len(names)} photos (not {shortlist(missing)})"
            if found.turned:
                raise BadInputError(
                    f"{lost}: the background stands while the object turns, and on what turns there is too little texture; put something "
                    "with an irregular pattern, such as a newspaper, below the object, or turn it by less between photos."
                )
            raise BadInputError(
                f"{lost}; take sharp photos that overlap by two thirds, with texture in view, remove those of other places, or try "
                "poses.matching=exhaustive and more poses.max_features."
            )
        if not all(map(is_plausible_lens, found.cameras)):
            raise BadInputError(_tied_together(found.masked, any(e["mask"] or e.get("guess") for e in self.entries)))
        if missing:
            self.monitor.warn(f"{len(missing)} of {len(names)} photos could not be registered and were dropped ({shortlist(missing)}).")
            if found.masked and len(missing) > (1 - MIN_PLACED_SHARE) * len(names):
                self.monitor.warn("If they show the object in another position, too few of its features join both: bake each by itself.")
        if len(together := self._coinciding(found)) >= MIN_WARNED:
            self.monitor.warn(
                f"{len(together)} cameras coincide with others, but their photos differ ({shortlist(together)}); if the object moved "
                "before a camera that stood, give masks of it (--masks)."
            )
        if len(result["steps"]) > 1:
            gains = ", ".join(f"{step}: {photos}" for step, photos in result["steps"])
            self.monitor.decide("registration", f"{count} of {len(names)} photos after {len(result['steps'])} steps", f"photos by {gains}")
        error = f"reprojection error {result['reprojection_px']:.2f} px"
        self.monitor.decide("structure from motion", f"{count} of {len(names)} photos registered", error)
        self.monitor.decide("sub-pixel observations", *result["refinement"].pop("decision"))
        figures = {
            "registered": count,
            "registered_share": count / len(names),
            "not_registered": missing,
            "reprojection_px": result["reprojection_px"],
            "points": result["points"],
            "track_length": result["track_length"],
            "cameras": len(lenses),
            "matching": kind,
            "masked_features": found.masked,
            "moving_features": found.region == "moving parts",
            "fine_features": result["fine_features"],
            "photos_detected": result["detected"],
            "pairs_matched": result["matched"],
            "pairs_verified": result["verified"],
            "refinement": result["refinement"],
            "seconds": result["seconds"],
        }
        if found.folder != self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)
            found.folder.rename(self.folder)
        return Solved(found.cameras, self.folder / "points.ply", figures, found.on_table)

    def _attempt(
        self, matching: str, region: Region = "whole photos", files: Path | None = None, background: StandingBackground | None = None
    ) -> _Attempt:
        """Structure from motion with features in a `region` of the photos, whose mask `files` are in a folder; each region has a database
        of its own. What stands in photos of one round before a `background` is not matched."""
        suffix = _FOLDERS[region]
        folder = self.scratch / f"solve{suffix}"
        job = self._job("solve", self.entries, files, [] if background is None else background.pairs)
        job |= {"matching": matching, "mapper": self.options.mapper, "work": str(self.scratch / f"colmap{suffix}")}
        result = self._run(job, folder)
        cameras = list(CameraSet.load(folder / "cameras.json").cameras) if result["registered"] else []
        return _Attempt(result, cameras, folder, region, background is not None)

    def _best_attempt(self, matching: str) -> _Attempt:
        """The solution with features in whole photos or inside the masks, as set, or the one that the masks support better. Features of a
        background that stands while the object turns are left out.

        Registration that looks complete is no evidence: a background that stands registers just as well.
        """
        masks, setting = FeatureMasks(self.ingest, self.entries, self.scratch / "feature_masks"), self.options.masked_features
        if setting is False:
            return self._attempt(matching)
        with self.monitor.part("background"):
            compared = find_standing_background({e["name"]: self.ingest / e["file"] for e in self.entries})
            background = compared if compared.stands else None
            moving = None if background is None else background.write_moving_parts(self.scratch / "moving_parts")

        def attempt(region: Region) -> _Attempt:
            if region in ("masks", "outside the masks"):
                return self._attempt(matching, region, masks.write(moving, region != "masks"), background)
            return self._attempt(matching, region, moving, background)

        if setting is True and masks.files:
            return attempt("masks")
        plain: Region = "whole photos" if background is None else "moving parts"
        first, evidence = plain, compared.evidence
        if background is None and compared.suspected and masks.complete and len(self.entries) >= MIN_CAPTURE:
            first, tried = self._trial(masks)
            evidence = f"{evidence}; {tried}"
        self.monitor.decide("features", _FEATURES[first], evidence)
        attempts = [attempt(first)]
        if not masks.complete:
            return attempts[0]
        if attempts[0].on_table and not self._lost(attempts[0]):
            self.monitor.decide("turntable", "found", f"{len(attempts[0].cameras)} of {len(self.entries)} photos on exact circles")
            return attempts[0]
        agreement = [self._agreement(attempts[0], masks)]
        if agreement[0] >= masks.min_agreement and not self._lost(attempts[0]):
            return attempts[0]
        attempts.append(attempt("masks" if first != "masks" else plain))
        agreement.append(self._agreement(attempts[1], masks))
        # A right model of one position of the object is worth more than a wrong one of both.
        score = [(a >= masks.min_agreement, a * len(found.cameras)) for a, found in zip(agreement, attempts, strict=True)]
        chosen = attempts[int(score[1] > score[0])]
        results = [
            f"to {a:.2f} with {len(found.cameras)} of {len(self.entries)} photos registered by features {_FEATURES[found.region]}"
            for a, found in zip(agreement, attempts, strict=True)
        ]
        self.monitor.decide("features", _FEATURES[chosen.region], f"masks agree with the cameras {results[0]}, {results[1]}")
        if max(agreement) < masks.min_agreement and not masks.guessed:
            self.monitor.warn(f"The masks agree with the cameras to {max(agreement):.2f} only: one of the two is wrong; look at the masks.")
        return chosen

    def _lost(self, attempt: _Attempt) -> bool:
        """Whether so many photos are missing that other features may place more of them."""
        return len(attempt.cameras) < MIN_PLACED_SHARE * len(self.entries)

    def _trial(self, masks: FeatureMasks) -> tuple[Region, str]:
        """The region of the features to begin with, by trial on small photos, and the evidence."""
        folder = self.scratch / "trial"
        shutil.rmtree(folder, ignore_errors=True)
        entries = write_small_photos(self.ingest, self.entries, folder / "photos")
        trials: list[Trial] = []
        for region in TRIED:
            small = FeatureMasks(self.ingest, entries, folder / f"masks{_FOLDERS[region]}")
            job = self._job("solve", entries, None if region == "whole photos" else small.write(outside=region != "masks"))
            job |= {"photos": str(folder / "photos"), "work": str(folder / f"colmap{_FOLDERS[region]}"), "cache": None, "max_size": SIZE}
            job |= {"matching": "exhaustive", "mapper": "trial", "max_features": min(FEATURES, self.options.max_features)}
            out = folder / f"solve{_FOLDERS[region]}"
            result = self._run(job, out, part="trial")
            cameras = list(CameraSet.load(out / "cameras.json").cameras) if result["registered"] else []
            agreement = self._agreement(_Attempt(result, cameras, out, region, False), masks)
            trials.append(Trial(region, len(cameras), len(entries), agreement, result["reprojection_px"] or 0.0))
            if trials[-1].usable(masks.min_agreement, MIN_PLACED_SHARE):
                break
        shutil.rmtree(folder, ignore_errors=True)
        return best_region(trials, masks.min_agreement), f"{len(entries)} small photos: {'; '.join(trial.text for trial in trials)}"

    def _agreement(self, attempt: _Attempt, masks: FeatureMasks) -> float:
        """Agreement of the registered cameras with the masks; 0 where their lens cannot exist, or cameras of different photos coincide."""
        if not all(map(is_plausible_lens, attempt.cameras)) or len(self._coinciding(attempt)) > MAX_COINCIDING * len(attempt.cameras):
            return 0.0
        return masks.agreement(attempt.cameras)

    def _coinciding(self, attempt: _Attempt) -> list[str]:
        """Names of cameras that coincide although their photos differ."""
        cloud = attempt.folder / "points.ply"
        files = {e["name"]: self.ingest / e["file"] for e in self.entries}
        return coinciding(attempt.cameras, read_cloud(cloud)[0], files) if cloud.exists() else []

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
        job |= {"cameras": str(self.ingest / "poses" / "cameras.json"), "lenses": given_lenses(cameras)}
        limit = max(MIN_SECONDS, SECONDS_PER_PHOTO * len(cameras))
        cloud = self.folder / "points.ply"
        solved = self._run(job, self.folder, limit)
        figures |= {k: solved[k] for k in ("points", "reprojection_px", "track_length", "epipolar_px", "seconds")}
        self.monitor.decide("tie points", f"{solved['points']} triangulated", "with the given poses")
        return Solved(cameras, cloud, figures)

    def _job(
        self, task: str, entries: Sequence[dict[str, Any]], masks: Path | None, one_camera: Sequence[tuple[str, str]] = ()
    ) -> dict[str, Any]:
        """Description of a job for the COLMAP process."""
        options = self.options
        return {
            "task": task,
            "photos": str(self.ingest / "photos"),
            "masks": None if masks is None else str(masks),
            "work": str(self.scratch / "colmap"),
            "cache": None if self.cache is None else str(self.cache),
            "lenses": solved_lenses(entries)[0],
            "one_camera": list(one_camera),
            "max_features": options.max_features,
            "peak_threshold": options.peak_threshold,
            "max_size": options.max_size,
            "fine": options.fine_features,
            "threads": self.threads,
            "seed": self.seed,
        }

    def _run(self, job: dict[str, Any], folder: Path, limit: float | None = None, part: str = "") -> dict[str, Any]:
        """Run the COLMAP process, with its results in `folder`, and time its parts, or all of it as one `part`.

        Raises what `run_job` raises, and what the monitor raises on a stop request.
        """
        work = Path(job["work"])
        if not _database_is_intact(work / "database.db"):
            self.monitor.warn("COLMAP's database of the interrupted run is damaged; structure from motion starts over.")
            shutil.rmtree(work)
        work.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        with PartSequence(self.monitor) as parts:

            def progress(step: str, done: int, total: int) -> None:
                parts.start(part or step)
                self.monitor.progress(done, total, f"{part}: {step}" if part else step)

            result = run_job(job, folder, JobCallbacks(progress, self.monitor.stop_requested), limit)
        if result is None:
            self.monitor.check_stop()
            raise InterruptedRun("Stopped on request.")
        return result


def _tied_together(masked: bool, masks: bool) -> str:
    """The message of a solution whose lens cannot exist."""
    cause = "Structure from motion found no cameras that explain all photos: the object probably moved against its surroundings"
    if masked:
        return f"{cause}, or too little of it is sharp; remove the photos in which it lies otherwise, or add photos that overlap more."
    how = "correct masks" if masks else "masks"
    moved = "as on a turntable or when it is laid down otherwise"
    return f"{cause}, {moved}; give {how} of the object with --masks, or bake each position by itself."


def _database_is_intact(path: Path) -> bool:
    """Whether an SQLite database passes its own check; True where there is none."""
    if not path.exists():
        return True
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)) as base:
            return bool(base.execute("PRAGMA integrity_check").fetchone() == ("ok",))
    except sqlite3.Error:
        return False
