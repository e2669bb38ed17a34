"""Structure from motion of a capture, or triangulation with given poses: jobs for the COLMAP process, and their outcome."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.capture.photos.undistortion import lens_key
from gsbake.capture.sfm.pairs import choose_matching
from gsbake.capture.sfm.process import SolveFailedError, Watch, run_job
from gsbake.capture.sfm.static_background import standing_background
from gsbake.config.schema import Poses
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.monitor import Monitor
from gsbake.text import shortlist

#: Time limit of triangulation with given poses, per photo and at least: its points only initialise training.
SECONDS_PER_PHOTO, MIN_SECONDS = 3.0, 120.0


@dataclass(frozen=True)
class Solved:
    """Cameras in the input frame, the file of triangulated points (may be absent), and the figures."""

    cameras: list[Camera]
    cloud: Path
    figures: dict[str, Any]


@dataclass(frozen=True)
class Solver:
    """One capture to solve: the `ingest` folder with the `entries` of its photos, the folder `scratch` for COLMAP's files."""

    ingest: Path
    entries: Sequence[dict[str, Any]]
    scratch: Path
    options: Poses
    seed: int
    threads: int
    monitor: Monitor

    @property
    def folder(self) -> Path:
        """Where results are written: `cameras.json`, `points.ply` and `sparse/` (COLMAP binary model)."""
        return self.scratch / "solve"

    def solve(self) -> Solved:
        """Structure from motion. Raises BadInputError when too few photos register."""
        names = sorted(e["name"] for e in self.entries)
        kind, why = choose_matching(self.options.matching, names)
        self.monitor.decide("matching", kind, why)
        masks = self._feature_masks()
        job = self._job("solve", self.entries, masks) | {"matching": kind, "mapper": self.options.mapper}
        result = self._run(job)
        assert result is not None  # without a limit only a stop ends it early, and that raises
        count, lost = int(result["registered"]), list(result["missing"])
        if count < max(3, self.options.min_registered * len(names)):
            raise BadInputError(
                f"Structure from motion registered only {count} of {len(names)} photos (not {shortlist(lost)}); take sharp photos that "
                "overlap by two thirds, with texture in view, remove those of other places, or try poses.matching=exhaustive and more "
                "poses.max_features."
            )
        if lost:
            self.monitor.warn(f"{len(lost)} of {len(names)} photos could not be registered and were dropped ({shortlist(lost)}).")
        error = f"reprojection error {result['reprojection_px']:.2f} px"
        self.monitor.decide("structure from motion", f"{count} of {len(names)} photos registered", error)
        figures = {
            "registered": count,
            "registered_share": count / len(names),
            "not_registered": lost,
            "reprojection_px": result["reprojection_px"],
            "points": result["points"],
            "track_length": result["track_length"],
            "cameras": len(job["lenses"]),
            "matching": kind,
            "masked_features": masks is not None,
            "fine_features": result["fine_features"],
            "seconds": result["seconds"],
        }
        return Solved(list(CameraSet.load(self.folder / "cameras.json").cameras), self.folder / "points.ply", figures)

    def triangulate(self) -> Solved:
        """Tie points for given poses: those that came with them, or triangulated here. Raises BadInputError with fewer than 3 poses."""
        cameras = list(CameraSet.load(self.ingest / "poses" / "cameras.json").cameras)
        if len(cameras) < 3:
            raise BadInputError(f"Only {len(cameras)} photos have a pose in the file given, but at least 3 are needed.")
        figures: dict[str, Any] = {"registered": len(cameras), "registered_share": len(cameras) / len(self.entries), "points": 0}
        known = self.ingest / "poses" / "points.ply"
        if known.exists():
            self.monitor.decide("tie points", "taken over", "the given model has them")
            return Solved(cameras, known, figures)
        posed = {c.name for c in cameras}
        job = self._job("triangulate", [e for e in self.entries if e["name"] in posed], None)
        job |= {"cameras": str(self.ingest / "poses" / "cameras.json"), "lenses": _given_lenses(cameras)}
        limit = max(MIN_SECONDS, SECONDS_PER_PHOTO * len(cameras))
        cloud = self.folder / "points.ply"
        try:
            solved = self._run(job, limit)
        except SolveFailedError as error:
            self.monitor.decide("tie points", "none", f"triangulation failed: {error}")
            return Solved(cameras, cloud, figures)
        if solved is None:
            self.monitor.decide("tie points", "none", f"triangulation took longer than {limit:.0f} s")
        else:
            figures |= {k: solved[k] for k in ("points", "reprojection_px", "track_length", "seconds")}
            self.monitor.decide("tie points", f"{solved['points']} triangulated", "with the given poses")
        return Solved(cameras, cloud, figures)

    def _job(self, task: str, entries: Sequence[dict[str, Any]], masks: Path | None) -> dict[str, Any]:
        """What the COLMAP process is told."""
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

    def _run(self, job: dict[str, Any], limit: float | None = None) -> dict[str, Any] | None:
        """Run the COLMAP process, timing its parts; None when it took longer than `limit` seconds."""
        Path(job["work"]).mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)
        with ExitStack() as running:
            current = ""

            def progress(part: str, done: int, total: int) -> None:
                nonlocal current
                if part != current:
                    running.close()
                    running.enter_context(self.monitor.part(part))
                    current = part
                self.monitor.progress(done, total, part)

            result = run_job(job, self.folder, Watch(progress, self.monitor.stop_requested), limit)
        if result is None:
            self.monitor.check_stop()
        return result

    def _feature_masks(self) -> Path | None:
        """Folder of masks under the names COLMAP looks for, when features are detected inside the masks only."""
        masked = [e for e in self.entries if e["mask"]]
        if self.options.masked_features is False or not masked:
            return None
        if self.options.masked_features == "auto":
            if len(masked) < len(self.entries):
                return None
            static, evidence = standing_background([(self.ingest / e["file"], self.ingest / e["mask"]) for e in self.entries])
            self.monitor.decide("features", "inside the masks" if static else "in whole photos", evidence)
            if not static:
                return None
        folder = self.scratch / "feature_masks"
        folder.mkdir(parents=True, exist_ok=True)
        for entry in masked:
            target = folder / f"{entry['name']}.png.png"
            with suppress(FileNotFoundError):
                target.unlink()
            shutil.copyfile(self.ingest / entry["mask"], target)
        return folder


def _lenses(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Photos grouped by what took them: photo size, and camera and focal length as EXIF names them."""
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
        groups.setdefault(lens_key(camera), []).append(camera)
    return [
        {"names": [c.name for c in members], "width": members[0].width, "height": members[0].height, "focal": None}
        for members in groups.values()
    ]
