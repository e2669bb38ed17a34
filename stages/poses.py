"""poses: cameras for the photos (solved, or checked when given), pinhole photos, and the unit frame around the object."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbake.pipeline.errors import BadInputError
from gsbake.pipeline.skip import leave_out
from gsbake.pipeline.stage import Context, Stage

if TYPE_CHECKING:
    from gsbake.capture.poses.normalisation import Extent
    from gsbake.geometry.cameras import Camera

#: Triangulation with given poses is a start for training, not a result: it may take this long, per photo and at least.
_SECONDS_PER_PHOTO, _LEAST_SECONDS = 3.0, 120.0
#: Fewer points than this say nothing about the shape.
_FEWEST_POINTS = 30
#: Places of the surface at which photos are compared.
_PLACES = 1000
#: Longer side of the masks that the hull is carved from.
_HULL_SIZE = 512
_PNG_LEVEL = 1


def run(ctx: Context) -> dict[str, Any]:
    """Solve or take the poses, undistort, normalise; see docs/architecture.md for the files."""
    from gsbake.geometry.cameras import CameraSet
    from gsbake.geometry.ply import read_cloud, write_cloud

    ingest = ctx.inputs["ingest"]
    entries: list[dict[str, Any]] = json.loads((ingest / "photos.json").read_text())["photos"]
    given = _settle_poses(ctx, ingest, len(entries))
    solving = ctx.checkpoint / "solve"
    if given:
        results, cameras, cloud_file = _take_given(ctx, entries, ingest, solving)
    else:
        results = _solve(ctx, entries, ingest, solving)
        cameras, cloud_file = list(CameraSet.load(solving / "cameras.json").cameras), solving / "points.ply"
    points, colours = read_cloud(cloud_file) if cloud_file.exists() else (None, None)
    with ctx.part("undistortion"):
        pinholes = _undistort(ctx, ingest, cameras)
    with ctx.part("normalisation"):
        masks = _small_masks(ctx, pinholes)
        extent = _extent(ctx, pinholes, masks, points)
    to_world = extent.similarity()
    to_unit = to_world.inverse()
    origin = "given" if given else "solved"
    unit = [c.moved(to_unit) for c in pinholes]
    cloud = None if points is None or len(points) < _FEWEST_POINTS else to_unit.apply(points)
    if cloud is not None:
        write_cloud(ctx.out / "points.ply", cloud, colours if colours is not None else cloud * 0)
    with ctx.part("masks"):
        _mend_masks(ctx, [(camera.moved(to_unit), mask) for camera, mask in masks], cloud)
    with ctx.part("photos that add nothing"):
        unit, dropped = _drop_spare(ctx, entries, unit, cloud)
    CameraSet(tuple(unit), to_world, origin).save(ctx.out / "cameras.json")
    if (solving / "sparse").exists():
        shutil.copytree(solving / "sparse", ctx.out / "sparse")
    ctx.decide("unit sphere", f"radius {extent.radius:.4g} in world units", extent.evidence)
    return {"poses": origin, **results, "dropped_photos": dropped, "centre": extent.centre.tolist(), "radius": extent.radius}


def _settle_poses(ctx: Context, ingest: Path, photos: int) -> bool:
    """Whether the given poses are used. Raises BadInputError when the profile counts on poses that were not given."""
    from gsbake.geometry.cameras import CameraSet

    known = ingest / "poses" / "cameras.json"
    if not known.exists() and ctx.settings.skip.poses == "always":
        raise BadInputError("No poses were given, but skip.poses is always; give poses with the photos or set it to auto.")
    evidence = "no poses were given"
    if known.exists():
        evidence = f"poses given for {len(CameraSet.load(known).cameras)} of {photos} photos"
    return leave_out(ctx, "poses", known.exists(), evidence, "structure from motion left out", "poses solved from the photos")


def _mend_masks(ctx: Context, masks: Sequence[tuple[Camera, Any]], cloud: Any) -> None:
    """Where tie points show that a mask leaves out a part of the object, put that part into its file; `masks` are small, with their cameras
    in the unit frame, as is the `cloud`."""
    import cv2
    import numpy as np

    from gsbake.capture.masks.completion import mend

    if cloud is None or any(mask is None for _, mask in masks):
        return
    mended = mend([camera for camera, _ in masks], [mask for _, mask in masks], cloud)
    names = [masks[one.index][0].name for one in mended]
    for one, name in zip(mended, names, strict=True):
        path = ctx.out / "masks" / f"{name}.png"
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise FileNotFoundError(path)
        missing = cv2.resize(255 * one.missing.astype(np.uint8), mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
        _write_png(path, np.where(missing > 127, 255, mask).astype(np.uint8))
    if mended:
        points = sum(one.points for one in mended)
        evidence = f"they left out {points} points that nearly all others hold: {_some(names)}"
        ctx.decide("masks mended", f"{len(mended)} of {len(masks)}", evidence)


def _write_png(path: Path, image: Any) -> None:
    """Write 8-bit pixels (h, w) or (h, w, 3) in OpenCV's order, coded quickly."""
    import cv2

    path.write_bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])[1].tobytes())


def _drop_spare(ctx: Context, entries: Sequence[dict[str, Any]], cameras: list[Camera], cloud: Any) -> tuple[list[Camera], list[str]]:
    """The cameras (unit frame) without the photos that add nothing, whose files go too, and the names of those."""
    import numpy as np

    from gsbake.capture.hull.visual_hull import visual_hull
    from gsbake.capture.photos.redundancy import spare_photos
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.geometry.cameras import CameraSet

    posed = PosedPhotos(ctx.out, CameraSet(tuple(cameras)))

    def surface() -> tuple[Any, Any]:
        if posed.has_masks:
            return visual_hull(posed).surface_points(_PLACES, ctx.seed)
        points = np.zeros((0, 3)) if cloud is None else cloud[np.linalg.norm(cloud, axis=1) < 1]
        return points[:: max(1, len(points) // _PLACES)], None

    mode = ctx.settings.skip.photos
    alike = {e["name"]: e["duplicate_of"] for e in entries if e["duplicate_of"]}
    spare, evidence = ([], "not looked for") if mode == "never" else spare_photos(cameras, alike, surface, mode == "always")
    names = [cameras[i].name for i in spare]
    choice = f"{len(names)} of {len(cameras)} photos left out ({_some(names)})" if names else "nothing to leave out"
    if not leave_out(ctx, "photos", bool(names), evidence, choice, f"all {len(cameras)} photos used"):
        return cameras, []
    for name in names:
        for sub in ("photos", "masks"):
            (ctx.out / sub / f"{name}.png").unlink(missing_ok=True)
    return [c for c in cameras if c.name not in set(names)], names


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


def _job(ctx: Context, task: str, entries: Sequence[dict[str, Any]], ingest: Path, masks: Path | None) -> dict[str, Any]:
    settings = ctx.settings.poses
    return {
        "task": task,
        "photos": str(ingest / "photos"),
        "masks": None if masks is None else str(masks),
        "work": str(ctx.checkpoint / "colmap"),
        "lenses": _lenses(entries),
        "max_features": settings.max_features,
        "peak_threshold": settings.peak_threshold,
        "max_size": settings.max_size,
        "fine": settings.fine_features,
        "threads": ctx.threads,
        "seed": ctx.seed,
    }


def _colmap(ctx: Context, job: dict[str, Any], out: Path, limit: float | None = None) -> dict[str, Any] | None:
    """Run COLMAP's process, timing its parts; None when it took longer than `limit`."""
    from gsbake.capture.sfm.process import Watch, run_job

    Path(job["work"]).mkdir(parents=True, exist_ok=True)
    shutil.rmtree(out, ignore_errors=True)
    with ExitStack() as running:
        current = ""

        def progress(part: str, done: int, total: int) -> None:
            nonlocal current
            if part != current:
                running.close()
                running.enter_context(ctx.part(part))
                current = part
            ctx.progress(done, total, part)

        result = run_job(job, out, Watch(progress, ctx.stop_requested), limit)
    if result is None:
        ctx.check_stop()
    return result


def _solve(ctx: Context, entries: Sequence[dict[str, Any]], ingest: Path, out: Path) -> dict[str, Any]:
    """Structure from motion; raises BadInputError when too few photos register."""
    from gsbake.capture.sfm.pairs import choose_matching

    settings = ctx.settings.poses
    names = sorted(e["name"] for e in entries)
    kind, why = choose_matching(settings.matching, names)
    ctx.decide("matching", kind, why)
    masks = _feature_masks(ctx, entries, ingest)
    job = _job(ctx, "solve", entries, ingest, masks) | {"matching": kind, "mapper": settings.mapper}
    result = _colmap(ctx, job, out)
    assert result is not None  # without a limit only a stop ends it early, and that raises
    count, lost = int(result["registered"]), list(result["missing"])
    if count < max(3, settings.min_registered * len(names)):
        raise BadInputError(
            f"Structure from motion placed only {count} of {len(names)} photos (not {_some(lost)}); take sharp photos that overlap by two "
            "thirds, with texture in view, leave out those of other places, or try poses.matching=exhaustive and more poses.max_features."
        )
    if lost:
        ctx.warn(f"{len(lost)} of {len(names)} photos could not be placed and were dropped ({_some(lost)}).")
    ctx.decide("structure from motion", f"{count} of {len(names)} photos placed", f"reprojection error {result['reprojection_px']:.2f} px")
    return {
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


def _feature_masks(ctx: Context, entries: Sequence[dict[str, Any]], ingest: Path) -> Path | None:
    """Folder of masks under the names COLMAP looks for, when features are to be found inside the masks only."""
    wanted = ctx.settings.poses.masked_features
    masked = [e for e in entries if e["mask"]]
    if wanted is False or not masked:
        return None
    if wanted == "auto":
        if len(masked) < len(entries):
            return None
        from gsbake.capture.sfm.static_background import standing_background

        still, evidence = standing_background([(ingest / e["file"], ingest / e["mask"]) for e in entries])
        ctx.decide("features", "inside the masks" if still else "in whole photos", evidence)
        if not still:
            return None
    folder = ctx.checkpoint / "feature_masks"
    folder.mkdir(parents=True, exist_ok=True)
    for entry in masked:
        target = folder / f"{entry['name']}.png.png"
        with suppress(FileNotFoundError):
            target.unlink()
        shutil.copyfile(ingest / entry["mask"], target)
    return folder


def _take_given(
    ctx: Context, entries: Sequence[dict[str, Any]], ingest: Path, out: Path
) -> tuple[dict[str, Any], list[Camera], Path]:
    """Results, cameras and point file of a capture whose poses are known."""
    from gsbake.capture.sfm.process import SolveFailedError
    from gsbake.geometry.cameras import CameraSet

    cameras = list(CameraSet.load(ingest / "poses" / "cameras.json").cameras)
    if len(cameras) < 3:
        raise BadInputError(f"Only {len(cameras)} photos have a pose in the file given, but at least 3 are needed.")
    results: dict[str, Any] = {"registered": len(cameras), "registered_share": len(cameras) / len(entries), "points": 0}
    known_points = ingest / "poses" / "points.ply"
    if known_points.exists():
        ctx.decide("points", "taken over", "the given model has them")
        return results, cameras, known_points
    posed = {c.name for c in cameras}
    job = _job(ctx, "triangulate", [e for e in entries if e["name"] in posed], ingest, None)
    job |= {"cameras": str(ingest / "poses" / "cameras.json"), "lenses": _given_lenses(cameras)}
    limit = max(_LEAST_SECONDS, _SECONDS_PER_PHOTO * len(cameras))
    try:
        solved = _colmap(ctx, job, out, limit)
    except SolveFailedError as error:
        ctx.decide("points", "none", f"triangulation failed: {error}")
        return results, cameras, out / "points.ply"
    if solved is None:
        ctx.decide("points", "none", f"triangulation took longer than {limit:.0f} s")
    else:
        results |= {k: solved[k] for k in ("points", "reprojection_px", "track_length", "seconds")}
        ctx.decide("points", f"{solved['points']} triangulated", "with the given poses")
    return results, cameras, out / "points.ply"


def _given_lenses(cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """Photos grouped by their given intrinsics."""
    from gsbake.capture.photos.undistortion import lens_key

    groups: dict[tuple[float, ...], list[Camera]] = {}
    for camera in cameras:
        groups.setdefault(lens_key(camera), []).append(camera)
    return [
        {"names": [c.name for c in members], "width": members[0].width, "height": members[0].height, "focal": None}
        for members in groups.values()
    ]


def _undistort(ctx: Context, ingest: Path, cameras: Sequence[Camera]) -> list[Camera]:
    """Write photos and masks as a pinhole camera sees them; photos without distortion are copied as they are."""
    import cv2
    import numpy as np

    from gsbake.capture.photos.undistortion import lens_key, pinhole_of, remap_tables, resample

    groups: dict[tuple[float, ...], list[Camera]] = {}
    for camera in cameras:
        groups.setdefault(lens_key(camera), []).append(camera)
    (ctx.out / "photos").mkdir()
    if any((ingest / "masks" / f"{c.name}.png").exists() for c in cameras):
        (ctx.out / "masks").mkdir()
    cv2.setNumThreads(1)
    done = 0
    flat: dict[str, Camera] = {}
    with ThreadPoolExecutor(max(1, min(ctx.threads, 8))) as pool:
        for members in groups.values():
            target = pinhole_of(members[0])
            tables = remap_tables(members[0], target) if members[0].distortion else None

            def one(camera: Camera, tables: Any = tables, target: Camera = target) -> Camera:
                for sub, is_mask in (("photos", False), ("masks", True)):
                    source, goal = ingest / sub / f"{camera.name}.png", ctx.out / sub / f"{camera.name}.png"
                    if is_mask and not source.exists():
                        continue
                    if tables is None:
                        shutil.copyfile(source, goal)
                        continue
                    image = cv2.imread(str(source), cv2.IMREAD_GRAYSCALE if is_mask else cv2.IMREAD_COLOR)
                    if image is None:
                        raise FileNotFoundError(source)
                    _write_png(goal, resample(np.asarray(image, np.uint8), tables, is_mask))
                return replace(target, name=camera.name, R=camera.R, t=camera.t)

            for result in pool.map(one, members):
                flat[result.name] = result
                done += 1
                ctx.progress(done, len(cameras), "undistortion")
    return [flat[c.name] for c in cameras]


def _small_masks(ctx: Context, cameras: Sequence[Camera]) -> list[tuple[Camera, Any]]:
    """Each photo's mask at the size that hulls are carved from, None where it has none, and its camera."""
    import cv2

    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.geometry.cameras import CameraSet

    posed = PosedPhotos(ctx.out, CameraSet(tuple(cameras)))
    cv2.setNumThreads(ctx.threads)
    return [posed.mask(i, _HULL_SIZE) for i in range(len(cameras))]


def _extent(ctx: Context, cameras: Sequence[Camera], masks: Sequence[tuple[Camera, Any]], points: Any) -> Extent:
    """The ball around the object: from the visual hull when at least half of the photos have masks, else from what the cameras look at."""
    from gsbake.capture.poses.normalisation import extent_from_masks, extent_from_view

    masked = [(camera, mask) for camera, mask in masks if mask is not None]
    if len(masked) >= max(3, 0.5 * len(cameras)):
        extent = extent_from_masks([c for c, _ in masked], [m for _, m in masked])
        if extent is not None:
            return extent
        ctx.warn("The masks of the photos share no common object; check that white is the object (else set ingest.invert_masks).")
    return extent_from_view(cameras, points)


def _some(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


STAGE = Stage(
    name="poses",
    version=3,
    title="Camera poses",
    run=run,
    needs=("ingest",),
    settings=("poses.*", "skip.poses", "skip.photos"),
    seeded=True,
)
