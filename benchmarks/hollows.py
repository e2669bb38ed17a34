"""How much of the air that cameras see inside of the visual hull is open, and how much of the object was opened with it.

python -m benchmarks.hollows RUN CAPTURE [RUN CAPTURE …]

RUN is the folder of a run whose stages `poses` and `stereo` are finished, all photos with masks; CAPTURE has the ground truth in `gt/`.
Random points of the hull are *air* where three cameras see past them to the true surface, and *solid* where none does, both clear of it by
two pixels. Of a shape, a point is open where two cameras see past it: `open` is that share of the air, `wrong` that of the solid.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import report_runs
from benchmarks.hull import finished_stages
from benchmarks.truth import Surface, align, read_centres, read_truth
from gsbake.capture.hull.visual_hull import Hull, read_masks, unit_hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import UsageError
from gsbake.geometry.cameras import Camera
from gsbake.geometry.ply import read_mesh
from gsbake.geometry.raycast import RayCaster
from gsbake.pipeline.store import Store

#: Random points in the hull's cells, longer side of the cameras' images, and pixels between a point and the true surface.
POINTS, SIZE, CLEAR = 40_000, 400, 2.0
#: Cameras that see past a point of the air, and past an open one.
AIR_CAMERAS, OPEN_CAMERAS = 3, 2


def seen_past(points: NDArray[np.float64], surface: Surface, cameras: Sequence[Camera], clear: float) -> NDArray[np.int64]:
    """Number of cameras (n,) that see the surface, or nothing, more than `clear` behind the points (n, 3)."""
    caster, count = RayCaster(surface.vertices, surface.faces), np.zeros(len(points), np.int64)
    for camera in cameras:
        depth = caster.depth(camera)
        pixel, z = camera.project(points)
        visible = camera.in_view(pixel, z)
        column, row = np.floor(pixel[visible]).astype(np.int64).T
        there = depth[row, column]
        count[visible] += (there <= 0) | (there > z[visible] + clear)
    return count


def shares(shapes: Sequence[Surface], hull: Hull, truth: Surface, cameras: Sequence[Camera]) -> list[tuple[float, float]]:
    """Open and wrongly opened share of each shape; all in one frame."""
    draw, centres = np.random.default_rng(0), hull.centres()
    points = centres[draw.integers(0, len(centres), POINTS)] + hull.cell * draw.uniform(-0.5, 0.5, (POINTS, 3))
    points = points[hull.signed_distance(points) < 0]
    cameras = [camera.downscaled_to(SIZE) for camera in cameras]
    pixel = float(np.mean([np.linalg.norm(points.mean(0) - c.centre) / c.fx for c in cameras]))
    air = points[seen_past(points, truth, cameras, CLEAR * pixel) >= AIR_CAMERAS]
    solid = points[seen_past(points, truth, cameras, -CLEAR * pixel) == 0]

    def share(shape: Surface, among: NDArray[np.float64]) -> float:
        return float((seen_past(among, shape, cameras, 0) >= OPEN_CAMERAS).mean()) if len(among) else float("nan")

    return [(share(shape, air), share(shape, solid)) for shape in shapes]


def measure_run(run: Path, capture: Path) -> list[tuple[str, float, float]]:
    """Name, open and wrong share of the hull, of what stereo left of it and, where they are finished, of the meshes.

    Raises UsageError when a stage is not finished or has no hull.
    """
    poses, stereo = finished_stages(run)
    if not (stereo / "hull.npz").exists():
        raise UsageError(f"{stereo} has no visual hull: not all photos have masks.")
    posed, truth = PosedPhotos.open(poses), read_truth(capture)
    hull = unit_hull(*read_masks(posed))
    found = {"visual hull": Surface(*hull.triangles()), "after stereo": Surface(*Hull.load(stereo / "hull.npz").triangles())}
    if meshes := Store(run).manifests("mesh"):
        for name in ("dense", "mesh"):
            vertices, faces = read_mesh(meshes[0][0] / f"{name}.ply")
            found[f"{name}.ply"] = Surface(np.asarray(vertices, float), np.asarray(faces, np.int64))
    frame = posed.cameras.to_world
    if posed.cameras.poses != "given":
        frame = frame.then(align(found["after stereo"].moved(frame), read_centres(poses / "cameras.json"), truth))
    values = shares(list(found.values()), hull, truth.surface.moved(frame.inverse()), posed.cameras.cameras)
    return [(name, *pair) for name, pair in zip(found, values, strict=True)]


def table(pairs: Sequence[tuple[Path, Path]]) -> str:
    """The table of all runs and their captures."""
    rows = [(capture.name, *row) for run, capture in pairs for row in measure_run(run, capture)]
    lines = [f"| {capture} | {name} | {opened:.3f} | {wrong:.4f} |" for capture, name, opened, wrong in rows]
    return "\n".join(["| capture | shape | open | wrong |", "|---|---|---|---|", *lines])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return report_runs("hollows", __doc__, table, arguments)


if __name__ == "__main__":
    sys.exit(main())
