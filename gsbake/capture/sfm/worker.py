"""The process in which COLMAP runs: reads a job (JSON file), writes the result into a folder, tells progress in JSON lines on stdout.

A process of its own because COLMAP's long calls cannot be interrupted from within but a process can be killed, and because its memory
goes back. It ends with its parent.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.poses.colmap_model import camera_of, cloud
from gsbake.capture.poses.up_axis import up_direction, upright_rotation
from gsbake.capture.sfm.colmap import pycolmap
from gsbake.capture.sfm.pairs import exhaustive, near_views
from gsbake.capture.sfm.reconstruction import Lens, Solver, registered_names
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.ply import write_cloud

#: When progress was last told: it is rationed, since mapping calls back thousands of times.
_LAST = {"time": 0.0}


def _tell(part: str, done: int, total: int) -> None:
    now = time.monotonic()
    if now - _LAST["time"] > 0.1 or done in (0, total):
        _LAST["time"] = now
        sys.stdout.write(json.dumps({"part": part, "done": done, "total": total}) + "\n")
        sys.stdout.flush()


def _follow_parent(parent: int) -> None:
    """End this process when its parent is gone, so that a killed run leaves nothing behind that eats the processor."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(75)

    threading.Thread(target=watch, daemon=True).start()


def _solver(job: Mapping[str, Any]) -> Solver:
    return Solver(
        folder=Path(job["photos"]),
        work=Path(job["work"]),
        lenses=[Lens(tuple(x["names"]), x["width"], x["height"], x["focal"]) for x in job["lenses"]],
        mask_folder=Path(job["masks"]) if job["masks"] else None,
        max_features=job["max_features"],
        peak_threshold=job["peak_threshold"],
        max_size=job["max_size"],
        fine=job["fine"],
        threads=job["threads"],
        seed=job["seed"],
        tick=_tell,
    )


def _write(model: Any, out: Path, solver: Solver, solved: bool) -> dict[str, Any]:
    """Write sparse/, cameras.json and points.ply of a reconstruction, turned upright when it was solved; returns its figures."""
    placed = sorted((im for im in model.images.values() if im.has_pose), key=lambda im: im.name)
    if solved:
        up = up_direction([np.asarray(im.cam_from_world().rotation.matrix()) for im in placed])
        rotation = upright_rotation(up)
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))
        placed = sorted((im for im in model.images.values() if im.has_pose), key=lambda im: im.name)
    (out / "sparse").mkdir(parents=True, exist_ok=True)
    model.write(str(out / "sparse"))
    cameras = [replace(camera_of(im, im.name, "the solved model"), name=im.name.rsplit(".", 1)[0]) for im in placed]
    CameraSet(tuple(cameras), poses="solved" if solved else "given").save(out / "cameras.json")
    points, colours = cloud(model)
    if len(points):
        write_cloud(out / "points.ply", points, colours)
    return {
        "registered": len(placed),
        "points": len(points),
        "fine_features": solver.upsampled,
        "reprojection_px": float(model.compute_mean_reprojection_error()) if len(points) else None,
        "track_length": float(model.compute_mean_track_length()) if len(points) else None,
        "missing": [name for name in solver.names if name not in registered_names(model)],
    }


def solve(job: Mapping[str, Any]) -> dict[str, Any]:
    """Find cameras and points of photos without poses."""
    solver = _solver(job)
    model = solver.solve(job["matching"], job["mapper"])
    if model is None or model.num_reg_images() == 0:
        return {"registered": 0, "points": 0, "reprojection_px": None, "missing": solver.names, "seconds": solver.seconds}
    out = Path(job["out"])
    model.extract_colors_for_all_images(str(solver.folder))
    return _write(model, out, solver, True) | {"seconds": solver.seconds}


def _known(base: Any, cameras: Mapping[str, Camera]) -> Any:
    """A reconstruction without points that holds known cameras under the database's ids; sets the intrinsics in the database too."""
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
        fresh = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(fresh, pose)
    return model


def triangulate(job: Mapping[str, Any]) -> dict[str, Any]:
    """Points for photos with known poses; cameras stay as they are."""
    solver = _solver(job)
    cameras = {c.name: c for c in CameraSet.load(Path(job["cameras"])).cameras}
    solver.features()
    ordered = [cameras[name] for name in solver.names]
    with closing(pycolmap.Database.open(str(solver.database))) as base:
        model = _known(base, cameras)
    if len(ordered) <= 12:
        pairs = exhaustive(len(ordered))
    else:
        pairs = near_views(np.stack([c.centre for c in ordered]), np.stack([c.view_direction for c in ordered]))
    solver.match(pairs)
    out = Path(job["out"])
    (out / "sparse").mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = solver.threads
    options.random_seed = solver.seed
    start = time.perf_counter()
    _tell("triangulation", 0, 1)
    model = pycolmap.triangulate_points(model, str(solver.database), str(solver.folder), str(out / "sparse"), True, options)
    solver.seconds["triangulation"] = time.perf_counter() - start
    return _write(model, out, solver, False) | {"seconds": solver.seconds}


def main() -> None:
    """Entry: `python -m gsbake.capture.sfm.worker JOB.json PARENT_PID`."""
    job = json.loads(Path(sys.argv[1]).read_text())
    _follow_parent(int(sys.argv[2]))
    pycolmap.set_random_seed(job["seed"])
    result = solve(job) if job["task"] == "solve" else triangulate(job)
    (Path(job["out"]) / "result.json").write_text(json.dumps(result))


if __name__ == "__main__":
    main()
