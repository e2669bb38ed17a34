"""COLMAP worker process: reads a job (JSON file), writes the result into a folder, reports progress in JSON lines on stdout.

COLMAP's long calls cannot be interrupted, but a process can be killed, and its memory is then released. The process ends with its parent.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
import traceback
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.colmap import pycolmap, repeatable_mapping
from gsbake.capture.poses.colmap_model import camera_of, cloud
from gsbake.capture.poses.up_axis import up_direction, upright_rotation
from gsbake.capture.sfm.epipolar import epipolar_error
from gsbake.capture.sfm.feature_cache import FeatureCache
from gsbake.capture.sfm.features import FeatureOptions
from gsbake.capture.sfm.pairs import exhaustive, neighbouring_views
from gsbake.capture.sfm.reconstruction import Lens, SfmPipeline, registered_names
from gsbake.capture.sfm.refined_adjustment import adjust_refined
from gsbake.errors import InterruptedRun
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.ply import write_cloud
from gsbake.system.processes import exit_with_parent

#: Errors of COLMAP and SQLite that come from the machine, not from the photos.
_PASSING_FAULT = re.compile(r"disk|I/O|no space|sqlite|database|bad_alloc|memory|failed to (open|write)|cannot (open|write)", re.IGNORECASE)
#: Time of the last progress line: lines are limited to ten per second, since mapping calls back thousands of times.
_LAST_REPORT = {"time": 0.0}


def _report_progress(part: str, done: int, total: int) -> None:
    now = time.monotonic()
    if now - _LAST_REPORT["time"] > 0.1 or done in (0, total):
        _LAST_REPORT["time"] = now
        sys.stdout.write(json.dumps({"part": part, "done": done, "total": total}) + "\n")
        sys.stdout.flush()


def _pipeline(job: Mapping[str, Any]) -> SfmPipeline:
    return SfmPipeline(
        folder=Path(job["photos"]),
        work=Path(job["work"]),
        lenses=[Lens(tuple(x["names"]), x["width"], x["height"], x["focal"]) for x in job["lenses"]],
        mask_folder=Path(job["masks"]) if job["masks"] else None,
        options=FeatureOptions(job["max_features"], job["peak_threshold"], job["max_size"], job["fine"]),
        threads=job["threads"],
        seed=job["seed"],
        tick=_report_progress,
        cache=FeatureCache(Path(job["cache"]) if job["cache"] else None),
        one_camera={frozenset(pair) for pair in job["one_camera"]},
    )


def _write(model: Any, out: Path, pipeline: SfmPipeline, solved: bool) -> dict[str, Any]:
    """Write sparse/, cameras.json and points.ply of a reconstruction, rotated upright if `solved`; returns its figures."""
    registered = sorted((im for im in model.images.values() if im.has_pose), key=lambda im: im.name)
    if solved:
        up = up_direction([np.asarray(im.cam_from_world().rotation.matrix()) for im in registered])
        rotation = upright_rotation(up)
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))
        registered = sorted((im for im in model.images.values() if im.has_pose), key=lambda im: im.name)
    (out / "sparse").mkdir(parents=True, exist_ok=True)
    model.write(str(out / "sparse"))
    cameras = [replace(camera_of(im, im.name, "the solved model"), name=im.name.rsplit(".", 1)[0]) for im in registered]
    CameraSet(tuple(cameras), poses="solved" if solved else "given").save(out / "cameras.json")
    points, colours = cloud(model)
    if len(points):
        write_cloud(out / "points.ply", points, colours)
    return {
        "registered": len(registered),
        "points": len(points),
        "fine_features": pipeline.detection.upsampled,
        "reprojection_px": float(model.compute_mean_reprojection_error()) if len(points) else None,
        "track_length": float(model.compute_mean_track_length()) if len(points) else None,
        "missing": [name for name in pipeline.names if name not in registered_names(model)],
    }


def solve(job: Mapping[str, Any]) -> dict[str, Any]:
    """Estimate cameras and tie points of photos without poses."""
    pipeline = _pipeline(job)
    model = pipeline.solve(job["matching"], job["mapper"])
    if model is None or model.num_reg_images() == 0:
        return {"registered": 0, "points": 0, "reprojection_px": None, "missing": pipeline.names, "seconds": pipeline.seconds}
    out = Path(job["out"])
    refinement: dict[str, Any] = {}
    if job["mapper"] != "trial":  # a trial's cameras only tell which features are tried first
        _report_progress("refinement", 0, 1)
        adjusted = adjust_refined(model, pipeline.folder, pipeline.options.max_size, partial(_report_progress, "refinement"))
        model, refinement = adjusted.model, adjusted.figures
        pipeline.seconds["refinement"] = refinement.pop("seconds")
    model.extract_colors_for_all_images(str(pipeline.folder))
    counts = {"detected": len(pipeline.detection.detected), "matched": pipeline.matched, "verified": pipeline.verified}
    figures = counts | {"steps": pipeline.steps, "seconds": pipeline.seconds, "refinement": refinement}
    return _write(model, out, pipeline, True) | figures


def _posed_model(base: Any, cameras: Mapping[str, Camera]) -> Any:
    """A reconstruction of known cameras under the database's ids, without points; also sets the intrinsics in the database."""
    model = pycolmap.Reconstruction()
    lenses: dict[int, Any] = {}
    for image in base.read_all_images():
        known = cameras[image.name.rsplit(".", 1)[0]]
        if image.camera_id not in lenses:
            k = (*known.distortion, *([0.0] * (8 - len(known.distortion))))
            lens = pycolmap.Camera(
                camera_id=image.camera_id,
                model="FULL_OPENCV" if any(k) else "PINHOLE",
                width=known.width,
                height=known.height,
                params=[known.fx, known.fy, known.cx, known.cy, *(k if any(k) else ())],
            )
            lens.has_prior_focal_length = True
            base.update_camera(lens)
            model.add_camera_with_trivial_rig(lens)
            lenses[image.camera_id] = lens
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(known.R), known.t)
        posed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(posed, pose)
    return model


def triangulate(job: Mapping[str, Any]) -> dict[str, Any]:
    """Triangulate tie points of photos with known poses, which stay unchanged."""
    pipeline = _pipeline(job)
    cameras = {c.name: c for c in CameraSet.load(Path(job["cameras"])).cameras}
    pipeline.features()
    ordered = [cameras[name] for name in pipeline.names]
    with closing(pycolmap.Database.open(str(pipeline.database))) as base:
        model = _posed_model(base, cameras)
    if len(ordered) <= 12:
        pairs = exhaustive(len(ordered))
    else:
        pairs = neighbouring_views(np.stack([c.centre for c in ordered]), np.stack([c.view_direction for c in ordered]))
    pipeline.match(pairs)
    out = Path(job["out"])
    (out / "sparse").mkdir(parents=True, exist_ok=True)
    options = repeatable_mapping(pipeline.seed)
    # Given lenses are right: COLMAP would leave out photos of long lenses, whose coefficients are large at small angles.
    options.max_extra_param = options.triangulation.max_extra_param = 1e6
    start = time.perf_counter()
    _report_progress("triangulation", 0, 1)
    model = pycolmap.triangulate_points(model, str(pipeline.database), str(pipeline.folder), str(out / "sparse"), True, options)
    pipeline.seconds["triangulation"] = time.perf_counter() - start
    figures = {"seconds": pipeline.seconds, "epipolar_px": epipolar_error(pipeline.database, cameras)}
    return _write(model, out, pipeline, False) | figures


def main() -> None:
    """Entry point: `python -m gsbake.capture.sfm.worker JOB.json PARENT_PID`."""
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    exit_with_parent(int(sys.argv[2]), InterruptedRun.exit_code)
    pycolmap.set_random_seed(job["seed"])
    try:
        result = solve(job) if job["task"] == "solve" else triangulate(job)
        (Path(job["out"]) / "result.json").write_bytes(json.dumps(result).encode())
    except Exception as error:
        passing = isinstance(error, OSError | MemoryError) or bool(_PASSING_FAULT.search(str(error)))
        try:
            sys.stderr.write(f"{' '.join(str(error).split())}\n" if passing else traceback.format_exc())
            sys.stderr.flush()
        except OSError:  # the log is on the disk that failed
            passing = True
        os._exit(InterruptedRun.exit_code if passing else 1)  # the interpreter's own end would fail on what is left for stderr


if __name__ == "__main__":
    main()
