"""Multi-view stereo of a posed capture: depth maps, a fused oriented point cloud, and the carved visual hull."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.hull.rigidity import moved_part
from gsbake.capture.hull.softness import SOFT, surface_softness
from gsbake.capture.hull.thin_parts import find_thin_parts
from gsbake.capture.hull.visual_hull import Hull, read_masks, unit_hull
from gsbake.capture.photos.roles import test_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Stereo
from gsbake.monitor import SILENT, Monitor
from gsbake.mvs.depth_maps import DepthMap
from gsbake.mvs.matching import StereoRun
from gsbake.mvs.mirror_images import without_mirror_images
from gsbake.mvs.outliers import find_outliers, without_points
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.mvs.pyramids import single_threaded_opencv
from gsbake.shape_refinement.hollows import open_hollows, with_field
from gsbake.shape_refinement.samples import Photo, load_photos

#: Minimum number of photos and longer side in pixels; below, matching finds too few depths.
MIN_PHOTOS, MIN_SIZE = 5, 200
#: Blur in pixels of the photos that open hollows.
HOLLOW_BLUR = 0.8
#: Density of points on thin parts, as a number of points over the whole object.
THIN_POINTS = 40_000


def run_stereo(
    poses: Path,
    out: Path,
    options: Stereo | None = None,
    *,
    ingest: Path | None = None,
    holdout: int = 8,
    seed: int = 0,
    threads: int = 2,
    scratch: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Match the photos of the folder `poses` and write depth maps and points into the folder `out`; return the figures.

    Written: `points.ply` (unit frame), `depth/<name>.npz`, and with masks `hull.npz` and `thin.npz`. Nothing is written where matching is
    skipped: by the options, or because photos are too few or too small. `ingest` has the photos at full size; without it the working photos
    are the largest. `scratch` keeps finished planes, so an interrupted run resumes.
    """
    options = options or Stereo()
    with FullPhotos(ingest, poses, readers=threads) as photos, ExitStack() as stack:
        reason = _skip_reason(photos.posed, options)
        if reason is not None:
            monitor.decide("stereo", "skipped", reason)
            return {"points": 0}
        if scratch is None:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gsbake-stereo-")))
        return _run(photos, out, options, holdout, seed, threads, scratch, monitor)


def _run(
    photos: FullPhotos, out: Path, options: Stereo, holdout: int, seed: int, threads: int, scratch: Path, monitor: Monitor
) -> dict[str, Any]:
    """See `run_stereo`."""
    posed, size = photos.posed, photos.size_of(options.max_size, options.min_scale)

    def report(done: int, text: str) -> None:
        monitor.check_stop()
        monitor.progress(min(done, len(posed)), len(posed), text)

    with single_threaded_opencv():
        hull, softness = _hull(posed, monitor)
        run = StereoRun(photos, size, options, hull, seed, threads, scratch / "planes", report)
        with monitor.part("photos"):
            run.prepare()
        if size > options.max_size:
            together = 1e-6 * sum(camera.width * camera.height for camera in run.cameras)
            monitor.decide("stereo size", f"{size} pixels", f"originals are larger; {together:.0f} megapixels together")
        with monitor.part("matching"):
            run.match()
        with monitor.part("consistency"):
            maps = run.filter_depths()
        if hull is not None and softness is not None:
            with monitor.part("mirror images"):
                maps = _without_mirror_images(maps, hull, softness, monitor)
        with monitor.part("fusion"):
            cloud, maps = _fuse(run, maps, hull, monitor)
        if hull is not None and softness is not None:
            opened = _open_hollows(posed, hull, softness, options, holdout, monitor)
            _carve(run, softness, opened, out, monitor)
    if hull is not None:
        _thin_parts(posed, hull, out, seed, monitor)
    (out / "depth").mkdir()
    for one in maps:
        one.save(out / "depth" / f"{one.camera.name}.npz")
    cloud.save(out / "points.ply")
    return _figures(run, maps, cloud, options, monitor)


def _skip_reason(posed: PosedPhotos, options: Stereo) -> str | None:
    """Why matching is skipped, or None."""
    if options.enabled == "never":
        return "set by the profile"
    size = float(np.median([max(c.width, c.height) for c in posed.cameras.cameras]))
    if options.enabled == "auto" and (len(posed) < MIN_PHOTOS or size < MIN_SIZE):
        return f"{len(posed)} photos of {size:.0f} pixels; {MIN_PHOTOS} photos of {MIN_SIZE} pixels are needed"
    return None


def _hull(posed: PosedPhotos, monitor: Monitor) -> tuple[Hull | None, NDArray[np.float32] | None]:
    """The visual hull, which bounds the depths, and the softness of its surface; None where a photo has no mask or the hull is empty."""
    hull, softness = None, None
    if posed.has_masks:
        with monitor.part("hull"):
            masks = read_masks(posed)
            hull = unit_hull(*masks)
            hull, softness = (None, None) if hull.empty else (hull, surface_softness(hull, *masks))
        with monitor.part("rigidity"):
            if hull is not None and (warning := moved_part(hull, *masks)):
                monitor.warn(warning)
    bounds = "visual hull" if hull is not None else "unit sphere"
    monitor.decide("depth bounds", bounds, "all photos have masks" if hull is not None else "not all photos have masks")
    return hull, softness


def _without_mirror_images(maps: list[DepthMap], hull: Hull, softness: NDArray[np.float32], monitor: Monitor) -> list[DepthMap]:
    """The depth maps without depths behind parts of the hull that are the object's surface by the silhouettes."""
    kept, share = without_mirror_images(maps, hull, softness)
    hard = float((softness[hull.occupancy] < SOFT).mean())
    evidence = f"they lie behind the object's surface by the silhouettes, which determine it for {100 * hard:.0f} % of the hull"
    monitor.decide("mirror images", f"{100 * share:.1f} % of the depths removed", evidence)
    return kept


def _fuse(run: StereoRun, maps: list[DepthMap], hull: Hull | None, monitor: Monitor) -> tuple[StereoCloud, list[DepthMap]]:
    """The fused cloud and the depth maps, without what lies outside the region, and without outlier components."""
    cloud = run.fuse(maps)
    if (region := run.posed.region) is not None:
        cloud, maps = cloud.select(region.contains(cloud.points)), [without_points(one, lambda p: region.distance(p) > 0) for one in maps]
    outliers = find_outliers(cloud, hull)
    if not outliers.points:
        return cloud, maps
    evidence = "components too small, or isolated and deep inside the hull (mirror images)"
    monitor.decide("outlier components", f"{outliers.points} points removed", evidence)
    return cloud.select(~outliers.contains(cloud.points)), [without_points(one, outliers.contains) for one in maps]


def _open_hollows(
    posed: PosedPhotos, hull: Hull, softness: NDArray[np.float32], options: Stereo, holdout: int, monitor: Monitor
) -> Hull:  # fmt: skip
    """The hull with the hollows that photos other than test photos show."""
    if options.hollows == "never" or posed.region is not None:  # a region's faces cut the object: photos disagree about their colour too
        return hull
    used = sorted(set(range(len(posed))) - set(test_photos(len(posed), holdout)))

    def load(size: int) -> list[Photo]:
        return load_photos(posed, used, size, HOLLOW_BLUR, monitor.check_stop)

    with monitor.part("hollows"):
        opened, verdicts = open_hollows(hull, softness, load, on_step=monitor.check_stop)
    share = sum(one.cells for one in verdicts) / max(int(hull.occupancy.sum()), 1)
    evidence = f"{sum(one.cells > 0 for one in verdicts)} of {len(verdicts)} places where photos disagree about the hull's colour"
    if errors := "; ".join(f"{one.closed:.4f}, opened {one.opened:.4f}" for one in verdicts):
        evidence += f"; relative squared errors of photos that the colours were not fitted to: {errors}"
    monitor.decide("hollows", f"{100 * share:.1f} % of the visual hull opened", evidence)
    return opened


def _carve(run: StereoRun, softness: NDArray[np.float32], opened: Hull, out: Path, monitor: Monitor) -> None:
    """Carve the hull where photos see through it, and write what neither that nor its hollows, which are `opened`, removes."""
    with monitor.part("carving"):
        carved = run.carved_hull(softness)
    with_field(carved.hull, np.maximum(carved.hull.field, opened.field)).save(out / "hull.npz")
    monitor.decide(
        "visual hull carving",
        f"{carved.carved_regions} regions carved",
        f"{100 * carved.share:.1f} % of the cells are free space before a surface; rejected: {carved.unsupported_regions} regions "
        f"without a surface behind or through a surface that silhouettes determine, {carved.silhouette_violations} that violate "
        f"silhouettes",
    )


def _thin_parts(posed: PosedPhotos, hull: Hull, out: Path, seed: int, monitor: Monitor) -> None:
    """Find parts thinner than a cell of the hull and write points on them."""
    with monitor.part("thin parts"):
        thin = find_thin_parts(posed, hull, THIN_POINTS, seed)
    found = f"{len(thin.points)} points" if len(thin.points) else "none"
    monitor.decide("thin parts", found, f"{100 * thin.share:.1f} % of the masks is narrower than a cell of the hull")
    thin.save(out / "thin.npz")


def _figures(run: StereoRun, maps: list[DepthMap], cloud: StereoCloud, options: Stereo, monitor: Monitor) -> dict[str, Any]:
    """The figures for the manifest."""
    inside = sum(run.pixels)
    confirmed = sum(map(len, maps)) / max(inside, 1)
    unmatched = sum(not n for n in run.sources)
    views = options.min_consistent_views
    evidence = f"{100 * confirmed:.0f} % of the object's pixels are confirmed by {views} or more other photos"
    monitor.decide("geometric consistency", f"{len(cloud)} points", evidence)
    if unmatched:
        monitor.decide("unmatched photos", str(unmatched), "no other photo shows the same surface 5 to 45 degrees away")
    return {
        "points": len(cloud),
        "confirmed_share": confirmed,
        "pixels": inside,
        "unmatched_photos": unmatched,
        "neighbours": float(np.mean([len(n) for n in run.sources])),
        "median_views": float(np.median(cloud.views)) if len(cloud) else 0.0,
    }
